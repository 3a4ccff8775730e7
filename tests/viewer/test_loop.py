"""The tracking loop: obeys, hands out every frame, and waits for no viewer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.camera.sequence import RecordedSequence
from handtrack.errors import InputError
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker
from handtrack.viewer.controls import FASTEST, Controls, Wishes
from handtrack.viewer.loop import TrackingLoop
from handtrack.viewer.playback import Playback
from oracles.collector import Collector, wait_until

MakeTracker = Callable[[str], HandTracker]
FREE = Wishes(tracker="hybrid", speed=FASTEST, repeat=False)


def loop_over(
    sample: RecordedSequence, make_tracker: MakeTracker, wishes: Wishes, **more: Any
) -> tuple[TrackingLoop, Controls]:
    controls = Controls(wishes)
    return TrackingLoop(Playback(sample), make_tracker, controls, **more), controls


def test_every_frame_is_tracked_handed_out_and_shown(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    loop, _ = loop_over(sample, make_tracker, FREE, viewer=collector, sinks=[collector])
    loop.run()
    assert collector.places == list(range(len(sample))) and loop.count == len(sample)
    assert [view.frame.index for view in collector.views] == collector.places
    assert all(view.hand.state is TrackState.TRACKING for view in collector.views)
    assert {view.tracker for view in collector.views} == {"hybrid"}
    assert collector.views[-1].rate > 0 and collector.views[-1].length == len(sample)
    assert collector.closed == 2, "as a viewer and as a sink"


def test_without_a_viewer_the_loop_is_the_same(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    loop, _ = loop_over(sample, make_tracker, FREE, sinks=[collector])
    loop.run()
    assert collector.places == list(range(len(sample)))


def test_steps_go_forward_and_back_and_then_it_stands_still(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    loop, controls = loop_over(
        sample, make_tracker, replace(FREE, paused=True), viewer=collector, sinks=[collector]
    )
    # The loop's turns, one by one; a recording that starts paused shows its first frame.
    for act in (lambda: None, lambda: None, controls.step, lambda: controls.step(3),
                lambda: controls.step(-2), lambda: controls.go_to(90)):  # fmt: skip
        act()
        assert loop.turn(controls.take())
    assert collector.places == [0, 1, 2, 3, 4, 2, 90]
    shown = len(collector.views)
    begin = time.perf_counter()
    assert loop.turn(controls.take()) and time.perf_counter() - begin > 0.1
    assert len(collector.views) == shown, "nothing changed, nothing is shown"


def test_another_tracker_takes_over_in_the_same_frame_and_is_made_once(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    made: list[str] = []

    def make(name: str) -> HandTracker:
        made.append(name)
        return make_tracker(name)

    loop, controls = loop_over(sample, make, replace(FREE, paused=True), viewer=collector)
    for _ in range(2):
        loop.turn(controls.take())
    for name in ("pso", "hybrid", "pso"):
        controls.change(tracker=name)
        loop.turn(controls.take())
    assert made == ["hybrid", "pso"]
    assert [view.tracker for view in collector.views] == ["hybrid", "pso", "hybrid", "pso"]
    assert {view.frame.index for view in collector.views} == {0}


def test_a_tracker_that_cannot_be_made_leaves_the_old_one_and_says_why(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    def make(name: str) -> HandTracker:
        if name == "pso":
            raise InputError("no room for particles")
        return make_tracker(name)

    loop, controls = loop_over(sample, make, FREE, viewer=collector)
    loop.turn(controls.take())
    controls.change(tracker="pso")
    for _ in range(2):
        loop.turn(controls.take())
    assert collector.views[-1].tracker == "hybrid" == controls.wishes.tracker
    assert "no room for particles" in collector.views[-1].notice
    loop, _ = loop_over(sample, make, replace(FREE, tracker="pso"), viewer=collector)
    with pytest.raises(InputError, match="no room"):
        loop.run()
    assert collector.closed == 1


def test_a_tracker_that_needs_a_pose_gets_it_at_the_start_and_after_jumps(
    sample: RecordedSequence, collector: Collector
) -> None:
    asked: list[int] = []

    def first_pose(frame: Any, tracker: HandTracker) -> np.ndarray:
        assert not tracker.automatic
        asked.append(frame.index)
        return frame.truth.pose

    def make(name: str) -> HandTracker:
        return HandTracker(sample.camera, tracker=name, device="cpu")

    loop, controls = loop_over(
        sample, make, replace(FREE, tracker="model_based"), viewer=collector, sinks=[collector],
        first_pose=first_pose,
    )  # fmt: skip
    for act in (lambda: None, lambda: None, lambda: controls.go_to(60), lambda: None,
                lambda: controls.go_to(59)):  # fmt: skip
        act()
        loop.turn(controls.take())
    assert collector.places == [0, 1, 60, 61, 59] and asked == [0, 60], "near jumps are tracked"
    assert collector.views[2].hand.state is TrackState.TRACKING


def test_a_tracker_that_finds_the_hand_starts_anew_after_a_jump(
    sample: RecordedSequence, make_tracker: MakeTracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    resets: list[object] = []
    tracker = make_tracker("hybrid")
    reset = tracker.reset
    monkeypatch.setattr(tracker, "reset", lambda pose=None: (resets.append(pose), reset(pose)))
    loop, controls = loop_over(sample, lambda _: tracker, FREE)
    counts = []
    for act in (lambda: None, lambda: None, lambda: controls.go_to(80), lambda: None):
        act()
        loop.turn(controls.take())
        counts.append(len(resets))
    assert counts[1] == counts[0] and counts[2] == counts[1] + 1 == counts[3]
    assert set(resets) == {None}


def test_recording_takes_the_frames_between_two_presses(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    recorders: list[Collector] = []

    def make_recorder() -> Collector:
        recorders.append(Collector())
        return recorders[-1]

    loop, controls = loop_over(
        sample, make_tracker, FREE, viewer=collector, make_recorder=make_recorder
    )
    for recording in (False, True, True, False, True):
        controls.change(recording=recording)
        loop.turn(controls.take())
    assert [one.places for one in recorders] == [[1, 2], [4]]
    assert [one.closed for one in recorders] == [1, 0]
    assert [view.recording for view in collector.views] == [False, True, True, False, True]
    controls.stop()
    loop.run()
    assert recorders[1].closed == 1


def test_a_recorder_that_cannot_be_made_is_told_and_tracking_goes_on(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    def make_recorder() -> Collector:
        raise OSError("disk full")

    wishes = replace(FREE, recording=True)
    loop, controls = loop_over(
        sample, make_tracker, wishes, viewer=collector, make_recorder=make_recorder
    )
    for _ in range(2):
        loop.turn(controls.take())
    assert not controls.wishes.recording
    assert "disk full" in collector.views[-1].notice and not collector.views[-1].recording


def test_at_the_end_it_repeats_or_waits_at_the_start_for_somebody_who_looks(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    loop, controls = loop_over(
        sample, make_tracker, replace(FREE, repeat=True), viewer=collector, sinks=[collector],
        linger=True,
    )  # fmt: skip
    last = len(sample) - 1
    controls.go_to(last)
    for _ in range(3):
        loop.turn(controls.take())
    assert collector.places == [last, 0]
    controls.change(repeat=False, place=last)
    for _ in range(3):
        loop.turn(controls.take())
    assert collector.places == [last, 0, last] and controls.wishes.paused
    controls.change(paused=False)
    loop.turn(controls.take())
    assert collector.places[-1] == 0


def test_hypotheses_come_on_demand_for_the_frame_that_is_shown(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector
) -> None:
    loop, controls = loop_over(
        sample, make_tracker, replace(FREE, paused=True), viewer=collector, device="cpu"
    )
    for _ in range(2):
        loop.turn(controls.take())
    controls.change(hypotheses=True)
    loop.turn(controls.take())
    before, after = (view.hypotheses for view in collector.views)
    assert before is None and after is not None
    assert len(after.errors) == len(after.keypoints) > 1
    assert (np.diff(after.errors) >= 0).all() and (after.errors > 0).all()
    true = collector.views[-1].hand.keypoints
    apart = np.linalg.norm(after.keypoints - true, axis=-1).mean(axis=-1)
    assert apart.min() < 0.03, "one of them is about the hand"
    assert collector.views[-1].hand is collector.views[0].hand, "tracking is not touched"


def test_the_loop_never_waits_for_a_viewer(
    sample: RecordedSequence, make_tracker: MakeTracker, collector: Collector, in_thread: Any
) -> None:
    from handtrack.viewer.mailbox import Mailbox

    class Slow:
        """A viewer whose thread needs half a second for each view."""

        def __init__(self) -> None:
            self.mailbox: Mailbox[Any] = Mailbox()
            self.drawn: list[int] = []

        def show(self, view: Any) -> None:
            self.mailbox.put(view)

        def work(self) -> None:
            while (view := self.mailbox.take()) is not None:
                self.drawn.append(view.frame.index)
                time.sleep(0.5)

        def close(self) -> None:
            self.mailbox.close()

    slow = Slow()
    in_thread(slow.work)
    loop, controls = loop_over(sample, make_tracker, FREE, viewer=slow, sinks=[collector])
    begin = time.perf_counter()
    in_thread(loop.run)
    wait_until(lambda: len(collector.frames) == len(sample))
    spent = time.perf_counter() - begin
    assert spent < 0.5 * len(sample) / 4 and len(slow.drawn) < len(sample) / 4
    controls.stop()
