"""The shape of the package: layers, names, sizes, and what importing it costs."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "handtrack"

STAGES = (
    "camera", "hand", "objects", "kernels", "priors", "synthesis", "forest", "fitting", "tracking",
    "physics", "grasp", "evaluation", "export", "viewer", "config", "cli",
)  # fmt: skip
"""In the order in which data flows: a stage imports only stages before it."""
ROOT_FILES = ("errors", "device", "transforms", "artifacts", "files", "optional")
"""Files that every stage may import, and that import nothing of the package but each other."""
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "core"}
MAX_LINES = 500

MODULES = sorted(PACKAGE.rglob("*.py"))


def module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_parts(path):
    """First name below handtrack of everything of handtrack that a file imports, with its line."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            if node.module == "handtrack":
                names = [f"handtrack.{alias.name}" for alias in node.names]
            else:
                names = [node.module or ""]
        else:
            continue
        for name in names:
            if name.split(".")[0] == "handtrack" and "." in name:
                yield name.split(".")[1], node.lineno


def allowed(stage):
    """What a stage or root file may import."""
    if stage in ROOT_FILES:
        return set(ROOT_FILES)
    if stage == "kernels":  # arrays in, arrays out
        return {"kernels", "errors"}
    # __version__ is of the package itself, and written beside results.
    return {*STAGES[: STAGES.index(stage) + 1], "kernels", *ROOT_FILES, "__version__"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_stage_imports_only_what_comes_before_it(path):
    stage = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if stage in ("__init__", "__main__"):
        return
    assert stage in STAGES + ROOT_FILES, f"{stage} has no place in the order of stages"
    wrong = [
        f"{path}:{line}: {stage} must not import {part}"
        for part, line in imported_parts(path)
        if part not in allowed(stage)
    ]
    assert not wrong, "\n".join(wrong)


def test_only_kernel_files_launch_kernels():
    wrong = []
    for path in MODULES:
        if path.parent.name == "kernels":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                owner = node.func.value
                is_warp = isinstance(owner, ast.Name) and owner.id in ("wp", "warp")
                if is_warp and node.func.attr in ("launch", "launch_tiled"):
                    wrong.append(f"{path}:{node.lineno}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_and_every_name_it_exports_is_there(path):
    if path.name == "__main__.py":
        return
    module = importlib.import_module(module_name(path))
    exported = getattr(module, "__all__", [])
    missing = [name for name in exported if not hasattr(module, name)]
    assert not missing
    assert len(set(exported)) == len(exported)


def test_the_public_names_are_told_by_dir():
    import handtrack

    assert set(handtrack.__all__) <= set(dir(handtrack))
    assert "__version__" in dir(handtrack)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = handtrack.nonsense


def test_importing_handtrack_is_quick_and_light():
    code = (
        "import sys, time\n"
        "start = time.perf_counter()\n"
        "import handtrack\n"
        "took = time.perf_counter() - start\n"
        "heavy = {'warp', 'mujoco', 'viser', 'cv2', 'scipy', 'sklearn'} & set(sys.modules)\n"
        "assert not heavy, f'imported at once: {heavy}'\n"
        "assert took < 1.0, f'{took:.2f} s'\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_no_file_is_long_enough_to_hold_two_ideas():
    long = {
        str(path.relative_to(PACKAGE)): lines
        for path in MODULES
        if (lines := len(path.read_text("utf-8").splitlines())) > MAX_LINES
    }
    assert not long


def test_no_folder_or_file_is_named_after_nothing():
    named = [
        path.relative_to(PACKAGE)
        for path in PACKAGE.rglob("*")
        if path.stem in FORBIDDEN_NAMES and "__pycache__" not in path.parts
    ]
    assert not named


def test_every_stage_folder_is_a_documented_package():
    for folder in (path for path in PACKAGE.iterdir() if path.is_dir()):
        if folder.name.startswith("_") or not any(folder.glob("*.py")):
            continue
        init = folder / "__init__.py"
        assert init.is_file(), f"{folder} has no __init__.py"
        assert ast.get_docstring(ast.parse(init.read_text("utf-8"))), f"{init} has no docstring"


def test_type_information_is_shipped():
    assert (PACKAGE / "py.typed").is_file()
