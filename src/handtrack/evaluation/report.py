"""Tables and files of measured cases: terminal, markdown, and the benchmark's JSON.

A case is a plain dictionary in the layout of the benchmark file::

    {"case": "...", "tracker": "...", "frames": n, "frames_per_second": x,
     "latency_ms": {"p50": x, "p95": x, "p99": x}, "stage_ms": {"render": x, ...},
     "keypoint_error_mm": {"mean": x, "median": x, "p95": x}, "success_rate": {"20": x, "30": x},
     "lost_rate": x, ...}

Tables show accuracy first and speed last, and only columns that some case fills.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

import handtrack
from handtrack.errors import InputError

Case = Mapping[str, Any]

# Title, path of keys, format. Accuracy first, speed last.
_COLUMNS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("case", ("case",), "{}"),
    ("tracker", ("tracker",), "{}"),
    ("frames", ("frames",), "{:d}"),
    ("success", ("success_rate",), "{:.1%}"),
    ("off mm", ("position_error_mm", "mean"), "{:.1f}"),
    ("off deg", ("rotation_error_deg", "mean"), "{:.1f}"),
    ("deepest mm", ("penetration_mm", "max"), "{:.1f}"),
    ("synthesis ms", ("synthesis_ms", "median"), "{:.0f}"),
    ("x real time", ("realtime_factor",), "{:.2f}"),
    ("mean mm", ("keypoint_error_mm", "mean"), "{:.3f}"),
    ("median mm", ("keypoint_error_mm", "median"), "{:.2f}"),
    ("p95 mm", ("keypoint_error_mm", "p95"), "{:.2f}"),
    ("phalanx mm", ("phalanx_error_mm", "mean"), "{:.3f}"),
    ("worst frame mm", ("phalanx_error_mm", "max_frame"), "{:.3f}"),
    ("depth error mm", ("depth_error_mm", "mean"), "{:.2f}"),
    ("in 20 mm", ("success_rate", "20"), "{:.1%}"),
    ("in 30 mm", ("success_rate", "30"), "{:.1%}"),
    ("in 40 mm", ("success_rate", "40"), "{:.1%}"),
    ("lost", ("lost_rate",), "{:.1%}"),
    ("missing", ("missing_rate",), "{:.1%}"),
    ("mean in 20 mm", ("within_20mm",), "{:.1%}"),
    ("facing", ("facing_within_20mm",), "{:.1%}"),
    ("back in 1", ("within_1",), "{:.1%}"),
    ("back in 5", ("within_5",), "{:.1%}"),
    ("sure but wrong", ("confident_wrong",), "{:.2%}"),
    ("longest", ("longest_wrong",), "{:d}"),
    ("search", ("longest_search",), "{:d}"),
    ("never found", ("never_found",), "{:d}"),
    ("tips mm", ("tip_error_mm", "mean"), "{:.1f}"),
    ("worst tip mm", ("tip_error_mm", "max"), "{:.1f}"),
    ("bones mm", ("bone_length_error_mm", "mean"), "{:.2f}"),
    ("bones p95 mm", ("bone_length_error_mm", "p95"), "{:.2f}"),
    ("surface mm", ("surface_error_mm", "mean"), "{:.2f}"),
    ("length mm", ("hand_length_error_mm", "mean"), "{:.2f}"),
    ("seconds", ("seconds", "mean"), "{:.1f}"),
    ("converged", ("converged_frames", "max"), "{:d}"),
    ("dropped", ("frames_dropped",), "{:d}"),
    ("age p50 ms", ("result_age_ms", "p50"), "{:.1f}"),
    ("memory +MB", ("memory_growth_mb",), "{:.1f}"),
    ("cost %", ("cost_percent",), "{:.1f}"),
    ("frames/s", ("frames_per_second",), "{:.1f}"),
    ("p50 ms", ("latency_ms", "p50"), "{:.2f}"),
    ("p95 ms", ("latency_ms", "p95"), "{:.2f}"),
    ("p99 ms", ("latency_ms", "p99"), "{:.2f}"),
)

_GROUPS: dict[str, tuple[str, ...]] = {
    "keypoint_error_mm": ("mean", "median", "p95"),
    "latency_ms": ("p50", "p95", "p99"),
    "phalanx_error_mm": ("mean", "max_frame"),
    "success_rate": ("20", "30"),
    "stage_ms": (),
}
"""Groups of numbers and the entries each must have."""

_RATES = (
    "lost_rate", "missing_rate", "within_20mm", "facing_within_20mm", "within_1", "within_5",
    "confident_wrong",
)  # fmt: skip
"""Entries that are shares."""


def check_case(case: Case) -> None:
    """Check one case against the layout of the benchmark file; further keys are allowed.

    Raises:
        InputError: A key is missing, has the wrong type, or holds a number that is not finite.
    """
    name = case.get("case")
    if not isinstance(name, str) or not name:
        raise InputError(f"a benchmark case needs a name under 'case', got {name!r}")
    if not isinstance(case.get("tracker"), str):
        raise InputError(f"case {name!r}: 'tracker' must be text, got {case.get('tracker')!r}")
    frames = case.get("frames")
    if not isinstance(frames, int) or isinstance(frames, bool) or frames < 1:
        raise InputError(f"case {name!r}: 'frames' must be a positive whole number, got {frames!r}")
    for group, needed in _GROUPS.items():
        if group not in case:
            continue
        entries = case[group]
        if group == "success_rate" and not isinstance(entries, Mapping):
            # Of trials that succeed or not, a share; of frames, one share for each threshold.
            _check_number(name, group, entries, highest=1.0)
            continue
        if not isinstance(entries, Mapping) or any(key not in entries for key in needed):
            raise InputError(
                f"case {name!r}: {group!r} must hold {', '.join(needed) or 'stages'}, "
                f"got {entries!r}"
            )
        for key, value in entries.items():
            _check_number(
                name, f"{group}.{key}", value, highest=1.0 if group == "success_rate" else math.inf
            )
    for key in ("frames_per_second", *_RATES):
        if key in case:
            _check_number(name, key, case[key], highest=1.0 if key in _RATES else math.inf)
    _check_finite(name, case)


def write_bench(
    path: str | Path, suite: str, device: str, cases: Sequence[Case], **more: Any
) -> dict[str, Any]:
    """Write the benchmark file.

    Args:
        path: JSON file to write; its folder must exist.
        suite: Name of the suite.
        device: Device the suite ran on, with its name where known.
        cases: The cases, each with its own name.
        **more: Further entries beside the cases, such as the command.

    Returns:
        What was written.

    Raises:
        InputError: A case does not follow the layout or two have the same name.
    """
    document = bench_document(suite, device, cases, **more)
    Path(path).write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return document


def bench_document(suite: str, device: str, cases: Sequence[Case], **more: Any) -> dict[str, Any]:
    """Content of the benchmark file: suite, device, versions, cases; see `write_bench`."""
    seen: set[tuple[str, str]] = set()
    cases = [_plain(case) for case in cases]
    for case in cases:
        check_case(case)
        key = (case["case"], case["tracker"])
        if key in seen:
            raise InputError(
                f"case {key[0]!r} with tracker {key[1]!r} occurs twice in suite {suite!r}"
            )
        seen.add(key)
    return {
        "suite": suite,
        "device": device,
        "versions": versions(),
        **more,
        "cases": cases,
    }


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on, and the machine."""
    found = {"handtrack": handtrack.__version__, "python": platform.python_version()}
    for package in ("numpy", "warp-lang"):
        try:
            found[package.removesuffix("-lang")] = version(package)
        except PackageNotFoundError:
            found[package.removesuffix("-lang")] = "unknown"
    found["platform"] = platform.platform()
    found["cpu"] = f"{cpu_model()}, {os.cpu_count()} logical cores"
    commit = git_commit()
    if commit:
        found["commit"] = commit
    return found


def cpu_model() -> str:
    """Name of the processor, as far as the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


def git_commit() -> str | None:
    """Commit of the checkout this package lies in, "+" after it if files differ; None elsewhere."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return None
    try:
        commit = _git(root, "rev-parse", "--short=12", "HEAD")
        return commit + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def bench_rows(cases: Sequence[Case]) -> tuple[list[str], list[list[str]]]:
    """Column titles and formatted cells of cases, for `terminal_table` or `markdown_table`."""
    used = [
        column for column in _COLUMNS if any(_get(case, column[1]) is not None for case in cases)
    ]
    rows = [[_format(_get(case, path), form) for _, path, form in used] for case in cases]
    return [title for title, _, _ in used], rows


def stage_rows(cases: Sequence[Case]) -> tuple[list[str], list[list[str]]]:
    """Column titles and formatted cells of the median time of every stage [ms]."""
    stages = list(dict.fromkeys(stage for case in cases for stage in case.get("stage_ms", {})))
    rows = [
        [
            str(case["case"]),
            *(_format(_get(case, ("stage_ms", stage)), "{:.3f}") for stage in stages),
        ]
        for case in cases
        if case.get("stage_ms")
    ]
    return ["case", *(f"{stage} ms" for stage in stages)], rows


def terminal_table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Table for `rich.console.Console.print`: text columns to the left, numbers to the right."""
    table = Table(title=title or None, title_justify="left", title_style="bold")
    for column, header in enumerate(headers):
        numeric = all(_is_number(row[column]) for row in rows)
        table.add_column(
            header,
            justify="right" if numeric and rows else "left",
            overflow="fold",
            no_wrap=numeric,
        )
    for row in rows:
        table.add_row(*row)
    return table


def markdown_table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table for the documentation, columns padded so that the source reads well too."""
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in (headers, *rows)]
    if any(len(row) != len(headers) for row in cells):
        raise InputError("every row of a table needs as many cells as there are headers")
    widths = [max(3, *(len(row[k]) for row in cells)) for k in range(len(headers))]
    numeric = [all(_is_number(row[k]) for row in cells[1:]) for k in range(len(headers))]

    def line(row: Sequence[str]) -> str:
        padded = (
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        )
        return "| " + " | ".join(padded) + " |"

    rule = [
        "-" * (w - 1) + ":" if right else "-" * w for w, right in zip(widths, numeric, strict=True)
    ]
    return "\n".join([line(cells[0]), "| " + " | ".join(rule) + " |", *map(line, cells[1:])]) + "\n"


def _get(case: Case, path: tuple[str, ...]) -> Any:
    """Value at a path of keys, None where there is none or a group of values."""
    value: Any = case
    for key in path:
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return None if isinstance(value, Mapping) else value


def _format(value: Any, form: str) -> str:
    """Value in its column's format, a dash for none."""
    return "-" if value is None else form.format(value)


def _is_number(cell: str) -> bool:
    """Whether a cell holds a number, a share or nothing."""
    try:
        float(cell.rstrip("%"))
    except ValueError:
        return cell == "-"
    return True


def _check_number(case: str, key: str, value: Any, *, highest: float) -> None:
    """Check that an entry is a number from 0 to a highest value."""
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not 0.0 <= value <= highest
    ):
        limit = f" of at most {highest:g}" if math.isfinite(highest) else ""
        raise InputError(
            f"case {case!r}: {key!r} must be a number not below 0{limit}, got {value!r}"
        )


def _check_finite(case: str, value: Any, key: str = "") -> None:
    """Check that everything can be written as JSON without loss."""
    if isinstance(value, Mapping):
        for name, entry in value.items():
            if not isinstance(name, str):
                raise InputError(
                    f"case {case!r}: key {name!r} under {key or 'the case'} must be text"
                )
            _check_finite(case, entry, f"{key}.{name}" if key else name)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            _check_finite(case, entry, key)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise InputError(f"case {case!r}: {key!r} is {value}, expected a finite number")
    elif value is not None and not isinstance(value, (str, int)):
        raise InputError(
            f"case {case!r}: {key!r} is a {type(value).__name__}; "
            "JSON takes text, numbers, lists and dictionaries"
        )


def _plain(value: Any) -> Any:
    """The same value with NumPy scalars and arrays turned into Python numbers and lists."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _git(root: Path, *arguments: str) -> str:
    """Output of a git command in a checkout."""
    done = subprocess.run(
        ["git", "-C", str(root), *arguments],
        capture_output=True,
        text=True,
        timeout=5.0,
        check=True,
    )
    return done.stdout.strip()
