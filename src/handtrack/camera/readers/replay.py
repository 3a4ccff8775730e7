"""A recording played as if it was a camera: at its own rate, over and over.

It stands in for a device in demonstrations and tests of everything that is live.
"""

from __future__ import annotations

import time

import numpy as np

from handtrack.camera.live import LiveImage, LiveInfo
from handtrack.camera.sequence import ASSUMED_RATE, RecordedSequence
from handtrack.errors import DeviceError, InputError

_HELD = 600
"""So many images of a recording are held in memory at most, so that disks do not set the pace."""


class ReplayDriver:
    """Live source that plays a recording.

    Args:
        recording: The recording; closed by whoever opened it.
        frames_per_second: How fast [1/s]; None takes the recording's rate.
    """

    def __init__(
        self, recording: RecordedSequence, *, frames_per_second: float | None = None
    ) -> None:
        rate = frames_per_second or recording.frames_per_second or ASSUMED_RATE
        if not 0 < rate < 1e4:
            raise InputError(f"frames_per_second is {rate!r}: expected a rate above 0")
        self._rate = rate
        frames = (recording[place] for place in range(min(len(recording), _HELD)))
        self._images = [frame.depth for frame in frames if frame.problem is None]
        if not self._images:
            raise InputError(f"{recording.name} has no readable frame to play")
        self._info = LiveInfo(
            name=f"replay of {recording.name}", camera=recording.camera, frames_per_second=rate,
            subject=recording.subject,
        )  # fmt: skip
        self._begin: float | None = None
        self.number = 0
        """Images so far that were due, whether or not somebody read them."""

    def open(self) -> LiveInfo:
        """Start to play."""
        self._begin, self.number = time.perf_counter(), 0
        return self._info

    def read(self, timeout: float) -> LiveImage | None:
        """Wait until the next image is due; those that are overdue are skipped, as in a camera."""
        if self._begin is None:
            raise DeviceError(f"{self._info.name} is not open")
        due = self._begin + self.number / self._rate
        wait = due - time.perf_counter()
        if wait > timeout:
            time.sleep(timeout)
            return None
        if wait > 0:
            time.sleep(wait)
        else:
            self.number += int(-wait * self._rate)
        number, self.number = self.number, self.number + 1
        return LiveImage(
            np.array(self._images[number % len(self._images)]), 1.0,
            self._begin + number / self._rate, number,
        )  # fmt: skip

    def close(self) -> None:
        """Stop."""
        self._begin = None
