"""The loop behind `handtrack view` and `handtrack live`: fetch a frame, track, hand out, show.

The loop obeys `Controls`, passes every tracked frame on to sinks (recorders, publishers), and shows
views to a `Viewer`, none of which may keep it waiting.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame, check_depth
from handtrack.errors import HandtrackError
from handtrack.tracking.result import HandResult
from handtrack.tracking.tracker import HandTracker
from handtrack.viewer.controls import Controls, Wishes
from handtrack.viewer.hypotheses import HypothesisFinder
from handtrack.viewer.playback import Playback
from handtrack.viewer.viewer import Hypotheses, NullViewer, View, Viewer

IDLE = 0.25
"""Longest wait without a look at anything else [s]."""

NEAR = 3
"""Jumps over so many frames of a recording are tracked over; after longer ones it starts anew."""

_RATED = 30
"""Frames over which the rate is measured."""


class Sink(Protocol):
    """Whatever takes tracked frames, such as a recorder or a publisher."""

    def frame(self, frame: DepthFrame, hand: HandResult, /) -> object:
        """Take a frame and what was found in it; what is returned is of no interest."""
        ...

    def close(self) -> None:
        """Finish; no frame follows."""
        ...


FirstPose = Callable[[DepthFrame, HandTracker], "NDArray[np.float64] | None"]
"""The pose in a frame by its labels, shape (28,), for trackers that find no hand by themselves."""


def no_first_pose(frame: DepthFrame, tracker: HandTracker) -> None:
    """Nothing tells a first pose."""
    del frame, tracker


class TrackingLoop:
    """Tracks the frames of a source as the user wants it."""

    def __init__(
        self,
        playback: Playback,
        make_tracker: Callable[[str], HandTracker],
        controls: Controls,
        *,
        viewer: Viewer | None = None,
        sinks: Iterable[Sink] = (),
        make_recorder: Callable[[], Sink] | None = None,
        first_pose: FirstPose = no_first_pose,
        linger: bool = False,
        device: str | None = None,
    ) -> None:
        """Gather the parts; nothing is tracked yet.

        Args:
            playback: Where frames come from.
            make_tracker: Makes the tracker of a name; each is made once, when it is first wanted.
            controls: What the user wants.
            viewer: Who is shown what; nobody when None.
            sinks: Who takes every tracked frame; closed at the end.
            make_recorder: Makes the sink for `Wishes.recording`.
            first_pose: Tells trackers that need it where the hand is.
            linger: Stay at the end of the source, for somebody who looks, instead of ending.
            device: Where hypotheses are computed: "cpu", "cuda:N" or None.
        """
        self.playback, self.controls = playback, controls
        self.count = 0
        """Frames tracked."""
        self._make_tracker, self._make_recorder = make_tracker, make_recorder
        self._viewer: Viewer = viewer if viewer is not None else NullViewer()
        self._sinks = list(sinks)
        self._first_pose, self._linger, self._device = first_pose, linger, device
        self._trackers: dict[str, HandTracker] = {}
        self._current: str | None = None
        self._recorder: Sink | None = None
        self._finder: HypothesisFinder | None = None
        self._notice = ""
        self._last: tuple[DepthFrame, HandResult] | None = None
        self._told: Wishes | None = None
        self._times: deque[float] = deque(maxlen=_RATED)
        self._jumped = True
        self._place = -1

    def run(self) -> None:
        """Track until the user stops it, or the source ends and nobody lingers.

        Raises:
            HandtrackError: The first tracker cannot be made, or a sink refuses a frame.
        """
        try:
            while not (wishes := self.controls.take()).stopped and self.turn(wishes):
                pass
        finally:
            self._close()

    def turn(self, wishes: Wishes) -> bool:
        """Obey, then track a frame or wait a little.

        Returns:
            Whether to go on.
        """
        switched = self._choose(wishes.tracker)
        self._record(wishes.recording)
        if wishes.place is not None:
            self._jump(wishes.place)
        elif wishes.steps < 0:
            self._jump(self._place + wishes.steps)
        moved = wishes.place is not None or wishes.steps != 0
        if wishes.paused and not moved:
            self._stand_still(wishes, switched)
            return True
        for _ in range(max(1, wishes.steps)):
            if not wishes.paused and self.controls.wait(self.playback.due_in(wishes.speed)):
                return True
            frame = self.playback.next()
            if frame is None:
                return self._at_end(wishes)
            self._track(frame, wishes)
        return True

    def _track(self, frame: DepthFrame, wishes: Wishes) -> None:
        """Track one frame, hand it out and show it."""
        hand = self._find(frame)
        self._place = self.playback.place
        self.count += 1
        self._times.append(time.perf_counter())
        if wishes.paused:
            # The time that a user takes to press a button is nobody's rate.
            self._times.clear()
        for sink in self._sinks:
            sink.frame(frame, hand)
        if self._recorder is not None:
            try:
                self._recorder.frame(frame, hand)
            except (HandtrackError, OSError) as error:
                self._stop_recording(error)
        self._last = (frame, hand)
        self._show(wishes)

    def _find(self, frame: DepthFrame) -> HandResult:
        """What the current tracker finds in a frame."""
        assert self._current is not None
        tracker = self._trackers[self._current]
        if self._jumped:
            pose = None if tracker.automatic else self._first_pose(frame, tracker)
            if tracker.automatic or pose is not None:
                tracker.reset(pose)
        self._jumped = False
        return tracker.track(frame.depth)

    def _show(self, wishes: Wishes) -> None:
        """Show the last frame as things are now."""
        if self._last is None:
            return
        frame, hand = self._last
        self._told = wishes
        times = self._times
        span = times[-1] - times[0] if len(times) > 1 else 0.0
        sequence = self.playback.sequence
        self._viewer.show(View(
            frame=frame, hand=hand, tracker=self._current or "",
            rate=(len(times) - 1) / span if span > 0 else np.nan,
            count=self.count, length=self.playback.length,
            paused=wishes.paused, recording=self._recorder is not None,
            dropped=sequence.dropped, delay=self._delay(frame),
            notice="; ".join(notice for notice in (frame.problem, self._notice) if notice),
            hypotheses=self._hypotheses(frame, hand) if wishes.hypotheses else None,
        ))  # fmt: skip

    @staticmethod
    def _delay(frame: DepthFrame) -> float:
        """Time since a live frame arrived [s], NaN for others."""
        return np.nan if frame.received is None else time.perf_counter() - frame.received

    def _hypotheses(self, frame: DepthFrame, hand: HandResult) -> Hypotheses | None:
        """Candidates for a frame."""
        clean, problem = check_depth(frame.depth, frame.camera)
        if problem is not None:
            return None
        if self._finder is None:
            self._finder = HypothesisFinder(hand.hand, frame.camera, device=self._device)
        return self._finder.find(clean, hand)

    def _stand_still(self, wishes: Wishes, switched: bool) -> None:
        """Paused: show what a changed wish makes of the last frame, then wait for the next one."""
        self._times.clear()
        self.playback.rest()
        if self._last is not None:
            if switched:
                self._last = (self._last[0], self._find(self._last[0]))
            if switched or self._told is None or _looks_different(wishes, self._told):
                self._show(wishes)
        elif self.playback.length:
            # A recording that starts paused shows its first frame.
            self.controls.step()
            return
        self.controls.wait(IDLE)

    def _at_end(self, wishes: Wishes) -> bool:
        """No frame is left: start again, wait for the user, or end."""
        if not (wishes.repeat or self._linger):
            return False
        rewound = self.playback.rewind()
        self._jumped = self._jumped or rewound
        if not (wishes.repeat and rewound):
            if not self._linger:
                return False
            self.controls.change(paused=True)
        return True

    def _jump(self, place: int) -> None:
        """Go to a frame of a recording."""
        if self.playback.go_to(place):
            # What was tracked elsewhere is no start for here.
            self._jumped = self._jumped or abs(self.playback.place + 1 - self._place) > NEAR
            self._times.clear()

    def _choose(self, name: str) -> bool:
        """Let a tracker take over; whether it is another one than before."""
        if name == self._current:
            return False
        tracker = self._trackers.get(name)
        if tracker is None:
            try:
                tracker = self._trackers[name] = self._make_tracker(name)
            except HandtrackError as error:
                if self._current is None:
                    raise
                self._notice = f"{name}: {error}"
                self.controls.change(tracker=self._current)
                return False
        self._current, self._notice = name, ""
        # One that finds the hand by itself shows that it does; the others go on from what is known.
        tracker.reset()
        known = self._last
        if not tracker.automatic and known is not None and known[1].state.sure:
            tracker.reset(known[1].pose)
        else:
            self._jumped = True
        return True

    def _record(self, wanted: bool) -> None:
        """Start or end a recording."""
        if wanted == (self._recorder is not None):
            return
        self._notice = ""
        try:
            if wanted and self._make_recorder is not None:
                self._recorder = self._make_recorder()
            elif self._recorder is not None:
                recorder, self._recorder = self._recorder, None
                recorder.close()
        except (HandtrackError, OSError) as error:
            self._stop_recording(error)
        if wanted and self._recorder is None:
            self.controls.change(recording=False)

    def _stop_recording(self, error: Exception) -> None:
        """Go on without a recorder that failed, and say so."""
        recorder, self._recorder = self._recorder, None
        self._notice = f"not recorded: {error}"
        self.controls.change(recording=False)
        if recorder is not None:
            with contextlib.suppress(HandtrackError, OSError):
                recorder.close()

    def _close(self) -> None:
        """Close all sinks, even when one of them fails, and the viewer."""
        ends: list[Any] = [*self._sinks, self._viewer]
        if self._recorder is not None:
            ends.insert(0, self._recorder)
        self._sinks, self._recorder = [], None
        failure: BaseException | None = None
        for end in ends:
            try:
                end.close()
            except Exception as error:
                failure = failure or error
        if failure is not None:
            raise failure


def _looks_different(now: Wishes, told: Wishes) -> bool:
    """Whether a view of the same frame would look different."""
    return (now.hypotheses, now.recording, now.paused) != (
        told.hypotheses, told.recording, told.paused,
    )  # fmt: skip
