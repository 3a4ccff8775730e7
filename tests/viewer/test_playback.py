"""Playback: recordings by their clock, with places; live sources as frames come."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from handtrack.camera.frame import DepthFrame
from handtrack.camera.sequence import RecordedSequence, Sequence
from handtrack.viewer.controls import FASTEST
from handtrack.viewer.playback import LATE, Playback


class Clock:
    """A clock that a test turns."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Stream(Sequence):
    """Frames one after the other, without a length."""

    def __init__(self, frames: list[DepthFrame], live: bool) -> None:
        self.name, self.camera = "stream", frames[0].camera
        self._frames, self._live = frames, live

    @property
    def live(self) -> bool:
        return self._live

    def __iter__(self) -> Iterator[DepthFrame]:
        return iter(self._frames)


def test_frames_come_in_order_until_the_end(sample: RecordedSequence) -> None:
    playback = Playback(sample)
    assert playback.length == len(sample)
    playback.go_to(len(sample) - 2)
    frames = [playback.next(), playback.next(), playback.next()]
    assert [frame and frame.index for frame in frames] == [len(sample) - 2, len(sample) - 1, None]
    assert playback.rewind()
    frame = playback.next()
    assert frame is not None and frame.index == 0


@pytest.mark.parametrize(("asked", "given"), [(-5, 0), (7, 7), (10_000, 149)])
def test_places_beyond_the_ends_are_the_ends(
    sample: RecordedSequence, asked: int, given: int
) -> None:
    playback = Playback(sample)
    assert playback.go_to(asked)
    frame = playback.next()
    assert frame is not None and frame.index == given == playback.place


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_frames_are_due_by_the_recordings_clock(sample: RecordedSequence, speed: float) -> None:
    clock = Clock()
    playback = Playback(sample, clock=clock)
    waited = 0.0
    for _ in range(31):
        due = playback.due_in(speed)
        waited += due
        clock.now += due
        playback.next()
    assert waited == pytest.approx((sample.times[30] - sample.times[0]) / speed)


def test_time_spent_tracking_counts_but_a_backlog_is_not_hurried(sample: RecordedSequence) -> None:
    clock = Clock()
    playback = Playback(sample, clock=clock)
    period = float(sample.times[1] - sample.times[0])
    playback.due_in(1.0)
    playback.next()
    clock.now += 0.4 * period
    assert playback.due_in(1.0) == pytest.approx(0.6 * period)
    clock.now += 20 * LATE
    assert playback.due_in(1.0) == 0.0
    playback.next()
    assert playback.due_in(1.0) == pytest.approx(period)


def test_nothing_is_waited_for_at_the_fastest_speed(sample: RecordedSequence) -> None:
    playback = Playback(sample, clock=Clock())
    for _ in range(3):
        assert playback.due_in(FASTEST) == 0.0
        playback.next()


@pytest.mark.parametrize("live", [True, False])
def test_a_stream_has_no_places(sample: RecordedSequence, live: bool) -> None:
    playback = Playback(Stream([sample[k] for k in range(3)], live), clock=Clock())
    assert playback.length is None and playback.live is live
    assert not playback.go_to(1) and not playback.rewind()
    assert playback.due_in(1.0) == 0.0
    assert [playback.next() is not None for _ in range(4)] == [True, True, True, False]
    playback = Playback(Stream([sample[k] for k in range(3)], live), clock=Clock())
    playback.due_in(1.0)
    playback.next()
    assert (playback.due_in(1.0) > 0) is not live, "a camera sets its own pace"
