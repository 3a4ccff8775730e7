"""The suite that measures what the viewer costs: its arithmetic, and that its processes work."""

from __future__ import annotations

from typing import Any

import pytest

from handtrack.evaluation.report import bench_document
from handtrack.evaluation.suites import viewer
from handtrack.evaluation.suites.suite import SuiteSettings, load_cases, run_suite


def test_each_round_is_compared_with_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    # The machine halves its speed after the first round; the viewer costs 5, 20 and 10 percent.
    rounds = [
        {"alone": [9.5, 9.5], "seen": [10.0, 10.0], "drawn": 29.0},
        {"alone": [16.0, 16.0], "seen": [20.0, 20.0], "drawn": 30.0},
        {"alone": [18.0, 18.0], "seen": [25.0, 15.0], "drawn": 28.0},
    ]
    monkeypatch.setattr(viewer, "_rounds", lambda *_: rounds)
    result = run_suite("viewer", SuiteSettings(device="cpu"))
    without, with_viewer = result.cases
    assert (without["case"], with_viewer["case"]) == ("without-viewer", "with-viewer")
    assert with_viewer["cost_percent"] == pytest.approx(10.0)
    assert with_viewer["cost_percent_spread"] == pytest.approx([7.5, 15.0])
    assert with_viewer["drawn_per_second"] == 29.0
    assert with_viewer["frames"] == 6 and with_viewer["latency_ms"]["p50"] == pytest.approx(17.5)
    (target,) = result.targets
    assert target.case == "with-viewer" and target.bound == 10.0 and target.passed
    bench_document("viewer", "cpu", result.cases)


@pytest.mark.slow
def test_the_loop_and_its_viewer_run_in_their_own_process() -> None:
    pytest.importorskip("viser", reason="viser is not installed")
    # Long enough for a view to fall due: without a first pose a frame takes half a millisecond.
    data: dict[str, Any] = load_cases("viewer") | {"rounds": 1, "frames": 600}
    (one,) = viewer._rounds("cpu", "model_based", data)
    assert len(one["alone"]) == len(one["seen"]) == 600
    assert min(one["alone"] + one["seen"]) > 0 and one["drawn"] > 0


def test_a_process_that_fails_says_why() -> None:
    data: dict[str, Any] = load_cases("viewer") | {"sequence": "data/README.md"}
    with pytest.raises(viewer.ViewerSuiteError, match=r"README\.md"):
        viewer._rounds("cpu", "hybrid", data)
