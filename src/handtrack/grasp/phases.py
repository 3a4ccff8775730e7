"""Phases of a grasp, in their order (thesis III.3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError

PHASES: tuple[str, ...] = ("reaching", "closing", "manipulation", "releasing")
"""Phases of a grasp in their order."""


def phase_numbers(names: ArrayLike, *, of: str) -> NDArray[np.int64]:
    """Number of each frame's phase, shape (nframe,).

    Args:
        names: Names of `PHASES`, shape (nframe,).
        of: Whose phases they are, for messages.

    Raises:
        InputError: A name is unknown, or phases are out of order.
    """
    given = np.asarray(names).tolist()
    unknown = sorted(set(given) - set(PHASES))
    if unknown:
        raise InputError(f"{of}: phase {unknown[0]!r} is unknown; expected {', '.join(PHASES)}")
    numbers = np.array([PHASES.index(name) for name in given], np.int64)
    if (np.diff(numbers) < 0).any():
        raise InputError(f"{of}: phases are out of order; expected {' then '.join(PHASES)}")
    return numbers
