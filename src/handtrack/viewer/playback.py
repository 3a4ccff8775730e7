"""The frames of a source at the pace that the user wants: recordings by their clock, live at once.

A recording can be stopped and searched; a live source gives its newest frame whenever one is asked
for, and drops the others itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from handtrack.camera.frame import DepthFrame
from handtrack.camera.sequence import RecordedSequence, Sequence
from handtrack.viewer.controls import FASTEST

LATE = 0.25
"""Behind the recording's clock by more than this [s], the clock is set back instead of hurried."""


class Playback:
    """A place in a source, and the clock that says when its next frame is due."""

    def __init__(
        self, sequence: Sequence, *, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """Start before the first frame.

        Args:
            sequence: An open source.
            clock: Gives the time [s]; only differences are used.
        """
        self.sequence = sequence
        self.live = sequence.live
        """Whether frames come from a device, and so cannot be waited for by a clock of ours."""
        self._recorded = sequence if isinstance(sequence, RecordedSequence) else None
        self._frames: Iterator[DepthFrame] | None = None
        self._ahead: DepthFrame | None = None
        self._clock = clock
        self._anchor: tuple[float, float] | None = None
        self._speed = 1.0
        self.place = -1
        """Number of the frame that was given last, -1 before the first."""

    @property
    def length(self) -> int | None:
        """Number of frames of a recording, None where it is not known."""
        return None if self._recorded is None else len(self._recorded)

    def next(self) -> DepthFrame | None:
        """The next frame; None at the end."""
        frame = self._read_ahead()
        if frame is None:
            return None
        self._ahead = None
        self.place += 1
        return frame

    def go_to(self, place: int) -> bool:
        """Let `next` give a certain frame.

        Args:
            place: Number of the frame; one beyond the ends is taken as the end.

        Returns:
            Whether the source can do that.
        """
        if self._recorded is None:
            return False
        self.place = min(max(place, 0), len(self._recorded) - 1) - 1
        self._ahead = None
        self.rest()
        return True

    def rewind(self) -> bool:
        """Start again from the first frame; whether the source can do that."""
        return self.go_to(0)

    def due_in(self, speed: float) -> float:
        """Time until the next frame is due [s]; 0 for live sources, and at the end.

        Args:
            speed: Multiple of the recording's own speed.
        """
        if self.live or speed == FASTEST:
            self._anchor = None
            return 0.0
        frame = self._read_ahead()
        if frame is None:
            return 0.0
        now = self._clock()
        if self._anchor is None or speed != self._speed:
            self._anchor, self._speed = (now, frame.time), speed
        due = self._anchor[0] + (frame.time - self._anchor[1]) / speed
        if now - due > LATE:
            self._anchor, due = (now, frame.time), now
        return max(0.0, due - now)

    def rest(self) -> None:
        """The clock stands still until the next frame is asked about."""
        self._anchor = None

    def _read_ahead(self) -> DepthFrame | None:
        """The frame that `next` will give."""
        if self._ahead is None:
            if self._recorded is not None:
                place = self.place + 1
                self._ahead = self._recorded[place] if place < len(self._recorded) else None
            else:
                self._frames = iter(self.sequence) if self._frames is None else self._frames
                self._ahead = next(self._frames, None)
        return self._ahead
