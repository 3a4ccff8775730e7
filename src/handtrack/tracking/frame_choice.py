"""Frames that together tell most about the shape of a hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtrack.fitting.shape_fitter import ShapeFitter

Float = NDArray[np.float64]

MOST_CANDIDATES = 60
"""Frames of a recording that are looked at, evenly spread."""


def choose_frames(
    fitter: ShapeFitter, depths: NDArray[np.float32], poses: Float, count: int
) -> NDArray[np.intp]:
    """Frames that leave the least uncertainty of the shape, one after the other.

    Args:
        fitter: Made for `count` images.
        depths: Depth images [m], shape (n, height, width), n >= count.
        poses: Poses of the mean hand there, shape (n, 28).
        count: So many are chosen.

    Returns:
        Their numbers, ascending, shape (count,).
    """
    total = len(depths)
    number = min(max(MOST_CANDIDATES, count), total)
    candidates = np.linspace(0, total - 1, number).round().astype(np.intp)
    told = []
    for first in range(0, len(candidates), count):
        part = np.resize(candidates[first : first + count], count)
        told.append(fitter.run(depths[part], poses[part], rounds=0).precisions)
    precisions = np.concatenate(told)[: len(candidates)]
    return np.sort(candidates[most_telling(precisions, fitter.prior_precision, count)])


def most_telling(precisions: Float, prior: Float, count: int) -> list[int]:
    """Members of a pool, chosen one by one, each the one that adds most to what is known.

    Args:
        precisions: What each tells, shape (n, nshape, nshape).
        prior: What is known without, shape (nshape, nshape).
        count: So many are chosen.
    """
    known, chosen = prior.copy(), []
    for _ in range(min(count, len(precisions))):
        gains = np.linalg.slogdet(known + precisions)[1]
        gains[chosen] = -np.inf
        best = int(np.argmax(gains))
        chosen.append(best)
        known = known + precisions[best]
    return chosen


def worth(precisions: Sequence[Float], prior: Float) -> float:
    """How much several images tell together: log determinant of what is known then."""
    return float(np.linalg.slogdet(prior + np.sum(precisions, axis=0))[1])
