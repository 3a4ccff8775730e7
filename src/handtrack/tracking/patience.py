"""How long to leave a scene alone that was searched in vain, so that waiting costs little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LONGEST = 8
"""Frames between searches of a scene that does not change, at most."""

MOVED = 0.04
"""A place farther than this from all that were refused is new [m]."""

Float = NDArray[np.float64]


class Patience:
    """Remembers the places of a scene that were refused."""

    def __init__(self) -> None:
        """Start with nothing refused."""
        self.forget()

    def forget(self) -> None:
        """Start anew."""
        self._centres, self._wait, self._left = np.empty((0, 3)), 0, 0

    @property
    def refused(self) -> bool:
        """Whether the last search ended in vain."""
        return self._wait > 0

    def refuse(self, centres: Float) -> None:
        """Remember a search in vain; the wait for the next one doubles.

        Args:
            centres: Middles of the places of the scene [m], shape (n, 3).
        """
        self._centres = np.array(centres, np.float64)
        self._wait = min(max(2 * self._wait, 1), LONGEST)
        self._left = self._wait

    def waits(self, centres: Float) -> bool:
        """Whether a scene is to be left alone; once per frame.

        Args:
            centres: Middles of its places now [m], shape (n, 3).
        """
        self._left -= 1
        if self._left <= 0:
            return False
        if not len(centres):
            return True
        if not len(self._centres):
            return False
        apart = np.linalg.norm(centres[:, None] - self._centres[None], axis=-1).min(axis=1)
        return not bool((apart > MOVED).any())
