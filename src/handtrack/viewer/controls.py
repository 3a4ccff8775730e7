"""What the user wants of the tracking loop, passed from any thread to the loop's own."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

from handtrack.errors import InputError

FASTEST = float("inf")
"""Speed that waits for no clock."""

SPEEDS: dict[str, float] = {
    "1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0, "fastest": FASTEST,
}  # fmt: skip
"""Name -> speed of playback, as a multiple of the recording's own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What the user wants at one moment."""

    tracker: str
    """Which tracker."""
    paused: bool = False
    """Wait after every frame."""
    speed: float = 1.0
    """Speed of a recording as a multiple of its own."""
    repeat: bool = True
    """Go on from the start of a recording after its end."""
    hypotheses: bool = False
    """Show what competes to explain each frame."""
    recording: bool = False
    """Record the frames."""
    stopped: bool = False
    """End the loop."""
    place: int | None = None
    """Frame of a recording to go to, once."""
    steps: int = 0
    """Frames to go on by while paused, once; negative goes back."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: The speed is not positive.
        """
        if not self.speed > 0:
            raise InputError(f"speed is {self.speed}: expected a positive number")


class Controls:
    """The user's wishes; any thread may change them, the tracking loop takes them."""

    def __init__(self, wishes: Wishes) -> None:
        """Start from given wishes."""
        self._changed = threading.Condition()
        self._wishes = wishes
        self._changes = 0
        self._taken = 0

    @property
    def wishes(self) -> Wishes:
        """What is wanted now."""
        return self._wishes

    def change(self, **fields: Any) -> None:
        """Replace some of the `Wishes`."""
        with self._changed:
            self._note(replace(self._wishes, **fields))

    def go_to(self, place: int) -> None:
        """Go to a frame of a recording."""
        self.change(place=place)

    def step(self, count: int = 1) -> None:
        """Pause, and go on by so many frames; negative goes back."""
        with self._changed:
            self._note(replace(self._wishes, paused=True, steps=self._wishes.steps + count))

    def stop(self) -> None:
        """End the loop."""
        self.change(stopped=True)

    def take(self) -> Wishes:
        """What is wanted now; wishes for one time are granted by this."""
        with self._changed:
            taken = self._wishes
            self._wishes = replace(taken, place=None, steps=0)
            self._taken = self._changes
            return taken

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most.

        Returns:
            Whether something was changed since the wishes were taken.
        """
        with self._changed:
            return self._changed.wait_for(lambda: self._changes != self._taken, seconds)

    def _note(self, wishes: Wishes) -> None:
        """Take over changed wishes and wake the loop."""
        if wishes != self._wishes:
            self._wishes = wishes
            self._changes += 1
            self._changed.notify_all()
