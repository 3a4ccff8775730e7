"""When a tracked pose needs competition: its depth error has jumped, or stays high for long."""

from __future__ import annotations

LEVEL_RATE = 0.05
"""Share of a frame's depth error in its running level: about 20 frames of memory."""

SUSPECT_PERIOD = 3
"""Frames between doubts of a pose that something else speaks against."""


class Doubt:
    """Watches the depth error over frames."""

    def __init__(self, *, error: float, jump: float, period: int, young: int = 0) -> None:
        """Start without memory.

        Args:
            error: Depth errors up to this are never doubted [m].
            jump: Errors above so much of the running level are doubted at once.
            period: Frames between doubts when the error is high but steady, as with a wrong shape.
            young: Frames for which a new track is doubted whenever its error is high; first poses
                are the least certain.
        """
        self._young = young
        self._error, self._jump, self._period = error, jump, period
        self.forget()

    def forget(self) -> None:
        """Start anew."""
        self._since, self._age, self._explained = 0, 0, False
        self.forget_level()

    def forget_level(self) -> None:
        """Compare errors anew, after a change that moves them all."""
        self._level: float | None = None

    @property
    def young(self) -> bool:
        """Whether the track is new and has not explained a frame well yet."""
        return not self._explained and self._age <= self._young

    def arises(self, error: float, *, suspected: bool = False) -> bool:
        """Whether the pose of this frame is to be doubted; once per frame.

        Args:
            error: Its depth error [m].
            suspected: Whether something else speaks against the pose, whatever its error.
        """
        self._since += 1
        self._age += 1
        if error <= self._error and not suspected:
            self._explained = True
            return False
        jumped = self._level is not None and error > self._jump * self._level
        period = 1 if self.young else SUSPECT_PERIOD if suspected else self._period
        if not jumped and self._since < period:
            return False
        self._since = 0
        return True

    def remember(self, error: float) -> None:
        """Take the error of the pose that was kept into the level."""
        level = error if self._level is None else self._level
        self._level = level + LEVEL_RATE * (error - level)
