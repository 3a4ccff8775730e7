"""Check the rules that every Warp kernel file follows.

A kernel is private (leading underscore), documented, and tells by the names of its arrays which it
reads (`_in`), writes (`_out`) or updates (`_io`). A launch names inputs, outputs and device, for a
launch on the wrong device can crash the process. A launcher allocates nothing, for a captured graph
must not.

Usage: python tools/check_kernels.py [FILE...]   (all of src/handtrack/kernels by default)
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

KERNELS = Path(__file__).resolve().parents[1] / "src" / "handtrack" / "kernels"

ARRAY_TYPES = {
    *("array", "array1d", "array2d", "array3d", "array4d"),
    *("indexedarray", "indexedarray1d", "indexedarray2d", "indexedarray3d", "indexedarray4d"),
}
ALLOCATORS = {"array", "clone", "empty", "empty_like", "from_numpy", "full", "full_like", "ones",
              "ones_like", "zeros", "zeros_like"}  # fmt: skip
SUFFIXES = ("_in", "_out", "_io")
LAUNCHES = {"launch", "launch_tiled"}


def check_source(source: str, name: str = "<kernels>") -> list[str]:
    """Violations in the text of one kernel file, as "name:line: what is wrong"."""
    tree = ast.parse(source, name)
    found: list[tuple[int, str]] = []
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        decorators = {_warp_name(decorator) for decorator in function.decorator_list}
        if "kernel" in decorators:
            found += _check_kernel(function)
        elif "func" not in decorators:
            found += _check_host(function)
    found += _check_launches(tree)
    return [f"{name}:{line}: {problem}" for line, problem in sorted(set(found))]


def _warp_name(node: ast.AST) -> str | None:
    """`x` of an expression wp.x, wp.x(...) or wp.x[...], else None."""
    while isinstance(node, (ast.Call, ast.Subscript)):
        node = node.func if isinstance(node, ast.Call) else node.value
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return node.attr if node.value.id in ("wp", "warp") else None
    return None


def _check_kernel(kernel: ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """Name, docstring, array arguments and writes of one kernel."""
    name = kernel.name
    if not name.startswith("_"):
        yield kernel.lineno, f"kernel {name} is public: its launcher is, call it _..."
    if not ast.get_docstring(kernel):
        yield kernel.lineno, f"kernel {name} has no docstring: say what one thread does"
    for argument in [*kernel.args.posonlyargs, *kernel.args.args, *kernel.args.kwonlyargs]:
        if argument.annotation is None:
            yield argument.lineno, f"argument {argument.arg} of {name} has no type"
        elif _warp_name(argument.annotation) in ARRAY_TYPES:
            if not argument.arg.endswith(SUFFIXES):
                yield argument.lineno, f"array {argument.arg} of {name} must end in _in, _out, _io"
    for node in ast.walk(kernel):
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        else:
            continue
        for target in targets:
            written = target.value if isinstance(target, ast.Subscript) else None
            if isinstance(written, ast.Name) and written.id.endswith("_in"):
                yield target.lineno, f"{name} writes {written.id}: call it _out or _io"


def _check_host(function: ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """No allocation in a function that runs on the host."""
    for call in _own_calls(function):
        called = _warp_name(call.func)
        if called in ALLOCATORS:
            problem = f"{function.name} calls wp.{called}: launchers allocate nothing, take the"
            yield call.lineno, f"{problem} array as an argument"


def _own_calls(function: ast.FunctionDef) -> Iterator[ast.Call]:
    """Calls in a function's body, without those in functions defined in it."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            if isinstance(node, ast.Call):
                yield node
            pending.extend(ast.iter_child_nodes(node))


def _check_launches(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every launch names inputs, outputs and device."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _warp_name(node.func) in LAUNCHES:
            given = {keyword.arg for keyword in node.keywords}
            missing = [word for word in ("inputs", "outputs", "device") if word not in given]
            if missing and None not in given:
                yield node.lineno, f"launch without {', '.join(f'{word}=' for word in missing)}"


def main(arguments: list[str]) -> int:
    """Check files and print what is wrong; 1 if anything is."""
    files = [Path(word) for word in arguments] or sorted(KERNELS.glob("*.py"))
    problems = [
        problem for file in files for problem in check_source(file.read_text("utf-8"), str(file))
    ]
    for problem in problems:
        print(problem)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
