"""The suite that runs the live loop for minutes: its arithmetic, and where frames go."""

from __future__ import annotations

import mmap

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.suites import live
from handtrack.evaluation.suites.suite import SuiteSettings, load_cases, run_suite


def test_growth_counts_from_when_memory_has_settled() -> None:
    times = np.arange(8.0)
    samples = np.array([100.0, 180.0, 200.0, 210.0, 208.0, 215.0, 209.0, 190.0])
    assert live.growth(samples, times, 2.0) == 15.0
    assert live.growth(samples, times, 5.5) == 0.0
    assert live.growth(samples, times, 99.0) == 0.0


def test_memory_that_is_held_is_seen() -> None:
    before = live.resident_mb()
    # Mapped anew: an array might lie in memory that the process has held all along.
    with mmap.mmap(-1, 50_000_000) as held:
        held[:: mmap.PAGESIZE] = bytes(len(range(0, len(held), mmap.PAGESIZE)))
        assert 40 < live.resident_mb() - before < 80


@pytest.mark.parametrize("device_is_software", [True, False])
def test_every_frame_is_tracked_or_counted_as_dropped(
    monkeypatch: pytest.MonkeyPatch, device_is_software: bool
) -> None:
    if device_is_software:
        pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed")
    else:
        monkeypatch.setattr(live, "installed", lambda extra: False)
    result = run_suite("live", SuiteSettings(device="cpu", minutes=2.0 / 60.0))
    (case,) = result.cases
    assert ("software device" in case["source"]) == device_is_software
    assert case["frames_unaccounted"] <= 3
    # Two seconds at 60 frames a second, and what came during the last frame.
    assert case["frames_sent"] >= 100
    assert 0 < case["frames_found"] <= case["frames_tracked"]
    assert case["result_age_ms"]["p50"] >= case["latency_ms"]["p50"] * 0.5
    assert {target.value for target in result.targets} == {
        "memory_growth_mb", "frames_unaccounted",
    }  # fmt: skip
    assert case["source"] in result.notes[0]


def test_the_time_must_be_positive_and_the_tracker_find_the_hand() -> None:
    with pytest.raises(InputError, match="--minutes is 0"):
        run_suite("live", SuiteSettings(minutes=0.0))
    with pytest.raises(InputError, match="needs a first pose"):
        run_suite("live", SuiteSettings(device="cpu", trackers=("model_based",), quick=True))


def test_ten_minutes_at_sixty_frames_a_second_are_asked_for() -> None:
    cases = load_cases("live")
    assert cases["minutes"] == 10.0 and cases["frames_per_second"] == 60
    assert {target["value"]: target["at_most"] for target in cases["targets"]} == {
        "memory_growth_mb": 20.0, "frames_unaccounted": 3.0,
    }  # fmt: skip
