from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from handtrack.errors import InputError
from handtrack.evaluation.report import (
    bench_rows,
    check_case,
    markdown_table,
    stage_rows,
    terminal_table,
    versions,
    write_bench,
)


def case(**changes: object) -> dict[str, object]:
    """A complete case of the benchmark file, with changes."""
    return {
        "case": "all/stride-1",
        "tracker": "model_based",
        "frames": 1498,
        "frames_per_second": 123.4,
        "latency_ms": {"p50": 8.1, "p95": 9.9, "p99": 12.0},
        "stage_ms": {"render": 2.0, "solve": 0.5},
        "keypoint_error_mm": {"mean": 3.25, "median": 2.5, "p95": 8.0},
        "success_rate": {"20": 0.91, "30": 0.97},
        "lost_rate": 0.015,
        **changes,
    }


def test_bench_file_has_the_documented_layout(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    extra = case(case="selftest", phalanx_error_mm={"mean": 0.9, "max_frame": 2.5}, rows=4)
    written = write_bench(path, "tracking", "cpu", [case(), extra], command="handtrack bench")
    read = json.loads(path.read_text())
    assert read == written
    assert list(read) == ["suite", "device", "versions", "command", "cases"]
    assert read["suite"] == "tracking" and read["device"] == "cpu"
    assert read["cases"] == [case(), extra]
    assert {"handtrack", "python", "numpy", "warp", "platform", "cpu"} <= set(read["versions"])


def test_numpy_numbers_are_written_as_plain_ones(tmp_path: Path) -> None:
    numbers = case(
        frames=np.int64(3),
        lost_rate=np.float32(0.5),
        spread=np.array([1.0, 2.0]),
        stage_ms={"render": np.float64(1.0)},
    )
    write_bench(tmp_path / "b.json", "speed", "cpu", [numbers])
    read = json.loads((tmp_path / "b.json").read_text())["cases"][0]
    assert read["frames"] == 3 and read["lost_rate"] == 0.5 and read["spread"] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"case": ""}, "needs a name"),
        ({"tracker": None}, "'tracker' must be text"),
        ({"frames": 0}, "'frames'"),
        ({"frames": True}, "'frames'"),
        ({"lost_rate": 1.5}, "at most 1"),
        ({"success_rate": {"20": 0.5}}, "must hold 20, 30"),
        ({"success_rate": {"20": 2.0, "30": 0.5}}, "success_rate.20"),
        ({"latency_ms": {"p50": 1.0}}, "p50, p95, p99"),
        ({"stage_ms": {"render": float("nan")}}, "stage_ms.render"),
        ({"frames_per_second": -1.0}, "not below 0"),
        ({"note": {"x": [1.0, float("inf")]}}, "note.x"),
        ({"note": {1: 2}}, "must be text"),
        ({"note": object()}, "object"),
    ],
)
def test_malformed_cases_are_refused(
    changes: dict[str, object], words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words):
        check_case(case(**changes))
    with pytest.raises(InputError, match=words):
        write_bench(tmp_path / "b.json", "tracking", "cpu", [case(**changes)])
    assert not (tmp_path / "b.json").exists()


def test_the_same_case_twice_is_refused(tmp_path: Path) -> None:
    write_bench(tmp_path / "b.json", "s", "cpu", [case(), case(tracker="other")])
    with pytest.raises(InputError, match="occurs twice"):
        write_bench(tmp_path / "b.json", "s", "cpu", [case(), case()])


def test_tables_show_accuracy_before_speed_and_only_used_columns() -> None:
    headers, rows = bench_rows([case(), {"case": "b", "tracker": "x", "frames": 2}])
    assert headers.index("mean mm") < headers.index("lost") < headers.index("frames/s")
    assert headers[-3:] == ["p50 ms", "p95 ms", "p99 ms"]
    assert "phalanx mm" not in headers and "in 40 mm" not in headers
    assert rows[0][headers.index("mean mm")] == "3.250"
    assert rows[0][headers.index("in 20 mm")] == "91.0%"
    assert rows[1][headers.index("mean mm")] == "-"


def test_stage_table_has_a_column_per_stage() -> None:
    headers, rows = stage_rows([case(), case(case="b", stage_ms={"solve": 1.0, "score": 2.0})])
    assert headers == ["case", "render ms", "solve ms", "score ms"]
    assert rows == [["all/stride-1", "2.000", "0.500", "-"], ["b", "-", "1.000", "2.000"]]


def test_markdown_aligns_numbers_right_and_escapes_bars() -> None:
    text = markdown_table(["case", "mm"], [["a|b", "3.25"], ["c", "-"]])
    assert text.splitlines() == [
        "| case |   mm |",
        "| ---- | ---: |",
        "| a\\|b | 3.25 |",
        "| c    |    - |",
    ]
    with pytest.raises(InputError, match="as many cells"):
        markdown_table(["a", "b"], [["1"]])


def test_terminal_table_prints_every_cell() -> None:
    out = io.StringIO()
    headers, rows = bench_rows([case()])
    Console(file=out, width=200).print(terminal_table("tracking", headers, rows))
    assert all(cell in out.getvalue() for cell in (*headers, *rows[0]))


def test_versions_are_text() -> None:
    found = versions()
    assert all(isinstance(value, str) and value for value in found.values())
    assert found["numpy"] == np.__version__
