"""Parts for tests of the viewer: one that keeps what it gets, and patience."""

from __future__ import annotations

import time
from collections.abc import Callable

from handtrack.camera.frame import DepthFrame
from handtrack.tracking.result import HandResult
from handtrack.viewer.viewer import View


class Collector:
    """A viewer and a sink that keep what they get."""

    def __init__(self) -> None:
        self.views: list[View] = []
        self.frames: list[DepthFrame] = []
        self.closed = 0

    def show(self, view: View) -> None:
        self.views.append(view)

    def frame(self, frame: DepthFrame, hand: HandResult) -> None:
        self.frames.append(frame)

    def close(self) -> None:
        self.closed += 1

    @property
    def places(self) -> list[int]:
        """Numbers of the frames that came."""
        return [frame.index for frame in self.frames]


def wait_until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait for something that another thread or process does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)
