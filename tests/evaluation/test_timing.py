from __future__ import annotations

import pytest

from handtrack.errors import InputError
from handtrack.evaluation.timing import StageTimer, percentiles


class Clock:
    """A clock that is told how late it is."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_stages_and_frames_are_summed_up() -> None:
    clock = Clock()
    timer = StageTimer(clock)
    for ms in (10, 20, 40):
        with timer.frame():
            with timer.stage("render"):
                clock.now += ms / 2000
            with timer.stage("solve"):
                clock.now += ms / 4000
            with timer.stage("render"):
                clock.now += ms / 8000
            clock.now += ms / 8000
    summary = timer.summary()
    assert summary.frames == len(timer) == 3
    assert list(summary.stage_ms) == ["render", "solve"]
    assert summary.stage_ms == pytest.approx({"render": 12.5, "solve": 5.0})
    assert summary.latency_ms["p50"] == pytest.approx(20.0)
    assert summary.frames_per_second == pytest.approx(50.0)
    assert summary.frames_per_second_spread == pytest.approx((37.5, 75.0))
    assert summary.to_dict()["latency_ms"]["p95"] == pytest.approx(38.0)


def test_times_from_elsewhere_and_skipped_warm_up() -> None:
    timer = StageTimer()
    timer.add_frame({"upload": 500.0}, total_ms=900.0)
    timer.add_frame({"upload": 1.0, "solve": 3.0})
    timer.add_frame({"upload": 2.0})
    summary = timer.summary(skip=1)
    assert summary.frames == 2
    assert summary.stage_ms == {"upload": 1.5, "solve": 3.0}
    assert summary.latency_ms["p50"] == 3.0
    with pytest.raises(InputError, match="no frames"):
        timer.summary(skip=3)


def test_a_frame_that_fails_is_not_counted() -> None:
    timer = StageTimer()
    with pytest.raises(KeyError), timer.frame(), timer.stage("render"):
        raise KeyError
    assert len(timer) == 0
    with timer.frame():
        pass
    assert len(timer) == 1


def test_misuse_is_explained() -> None:
    timer = StageTimer()
    with pytest.raises(InputError, match="inside"), timer.stage("render"):
        pass
    with timer.frame(), pytest.raises(InputError, match="another frame"), timer.frame():
        pass
    with pytest.raises(InputError, match="finite"):
        timer.add_frame({"render": float("nan")})


def test_percentiles_of_a_ramp() -> None:
    assert percentiles(range(101)) == {"p50": 50.0, "p95": 95.0, "p99": 99.0}
