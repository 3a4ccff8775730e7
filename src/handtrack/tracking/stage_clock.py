"""Where the time of a frame goes."""

from __future__ import annotations

import time


class StageClock:
    """Time spent per stage [ms]."""

    def __init__(self) -> None:
        self.spans: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """The time since the last lap goes to a stage."""
        now = time.perf_counter()
        self.spans[name] = self.spans.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
