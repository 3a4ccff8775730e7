"""Time warps between motions: registration by dynamic time warping, and log increments (Eq. III.2).

A warp is a strictly rising array: entry t is the frame of a motion, not a whole number as a rule,
that corresponds to frame t of the reference motion. Logarithms of its increments may take any
value, so linear statistics of them always give a warp back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError

Float = NDArray[np.float64]

OFF_DIAGONAL = 0.1
"""Cost of a step in one motion alone, as a share of the mean distance of all pairs of frames."""

SMOOTHING = 5
"""Frames of the reference over which a warp is averaged; dynamic time warping gives stairs."""

SLOPES = (0.1, 10.0)
"""Least and largest increment of a warp, as a share of its mean increment."""


def registered(reference: ArrayLike, motions: Sequence[ArrayLike]) -> list[Float]:
    """Warps that carry motions over to the time of a reference.

    Args:
        reference: Features of the reference, shape (nref, nfeature); all features count the same.
        motions: Features of the motions, each (nframe, nfeature), of any length from 2.

    Returns:
        One warp for each motion, shape (nref,), from 0 to nframe - 1.

    Raises:
        InputError: A motion is too short or of another number of features.
    """
    target = np.asarray(reference, np.float64)
    given = [np.asarray(motion, np.float64) for motion in motions]
    for motion in (target, *given):
        if motion.ndim != 2 or len(motion) < 2 or motion.shape[1] != target.shape[1]:
            raise InputError(
                f"a motion to register has shape {motion.shape}; expected at least 2 frames of "
                f"{target.shape[-1]} features"
            )
    if not given:
        return []
    lengths = np.array([len(motion) for motion in given])
    padded = np.stack([np.pad(m, ((0, lengths.max() - len(m)), (0, 0)), "edge") for m in given])
    squares = (target**2).sum(1)[:, None] + (padded**2).sum(2)[:, None]
    apart = np.sqrt((squares - 2.0 * target @ np.swapaxes(padded, 1, 2)).clip(0.0, None))
    return [
        _smooth(path, length) for path, length in zip(_paths(apart, lengths), lengths, strict=True)
    ]


def _paths(apart: Float, lengths: NDArray) -> list[Float]:
    """Mean frame of each motion that is matched to each frame of the reference (all at once).

    Args:
        apart: Distances of frames, shape (nmotion, nref, longest).
        lengths: Number of frames of each motion, shape (nmotion,).
    """
    count, nref, longest = apart.shape
    aside = OFF_DIAGONAL * apart.mean((1, 2))
    total = np.full((count, nref + 1, longest + 1), np.inf)
    total[:, 0, 0] = 0.0
    came = np.zeros((count, nref + 1, longest + 1), np.int8)
    # Cells of an anti-diagonal depend on earlier ones only, so all of one are done at once.
    for step in range(2, nref + longest + 1):
        i = np.arange(max(1, step - longest), min(nref, step - 1) + 1)
        j = step - i
        ways = np.stack(
            [
                total[:, i - 1, j - 1],
                total[:, i - 1, j] + aside[:, None],
                total[:, i, j - 1] + aside[:, None],
            ]
        )
        came[:, i, j] = ways.argmin(0)
        total[:, i, j] = ways.min(0) + apart[:, i - 1, j - 1]
    found = []
    for k, length in enumerate(lengths):
        sums, hits = np.zeros(nref), np.zeros(nref)
        i, j = nref, int(length)
        while i > 0 and j > 0:
            sums[i - 1] += j - 1
            hits[i - 1] += 1
            step = came[k, i, j]
            i, j = i - (step != 2), j - (step != 1)
        found.append(sums / hits)
    return found


def _smooth(path: Float, length: int) -> Float:
    """A strictly rising warp from 0 to length - 1 near a path of dynamic time warping."""
    steps = np.diff(path)
    width = min(SMOOTHING, len(steps))
    kernel = np.ones(width) / width
    padded = np.pad(steps, (width // 2, width - 1 - width // 2), mode="edge")
    steps = np.convolve(padded, kernel, mode="valid")
    mean = (length - 1) / len(steps)
    steps = steps.clip(SLOPES[0] * mean, SLOPES[1] * mean)
    return np.concatenate([[0.0], np.cumsum(steps * (length - 1) / steps.sum())])


def log_increments(warp: ArrayLike) -> Float:
    """z(t) = ln(w(t) - w(t - 1)), shape (..., nref - 1), of warps, shape (..., nref)."""
    return np.log(np.diff(np.asarray(warp, np.float64), axis=-1))


def warp_of(log_steps: ArrayLike) -> Float:
    """Warps from 0, shape (..., nref), of log increments, shape (..., nref - 1) (Eq. III.2)."""
    steps = np.exp(np.asarray(log_steps, np.float64))
    start = np.zeros((*steps.shape[:-1], 1))
    return np.concatenate([start, np.cumsum(steps, axis=-1)], axis=-1)


def resampled(values: ArrayLike, at: ArrayLike) -> Float:
    """Values between frames, linearly, shape (nout, n), of values (nframe, n) at frames (nout,)."""
    values, at = np.asarray(values, np.float64), np.asarray(at, np.float64)
    low = np.clip(np.floor(at).astype(int), 0, max(len(values) - 2, 0))
    share = (at - low).clip(0.0, 1.0)[:, None]
    return (1.0 - share) * values[low] + share * values[np.minimum(low + 1, len(values) - 1)]


def unwarped(values: ArrayLike, warps: ArrayLike, nframe: int) -> Float:
    """Motions in their own time from motions in the reference's (the warping of Eq. III.3).

    Args:
        values: In the time of the reference, shape (n, nref, nvalue).
        warps: Shape (n, nref).
        nframe: Number of frames wanted, evenly over the duration of each motion.

    Returns:
        Shape (n, nframe, nvalue).
    """
    values, warps = np.asarray(values, np.float64), np.asarray(warps, np.float64)
    count, nref = warps.shape
    even = np.linspace(0.0, 1.0, nframe)
    share = warps / warps[:, -1:]
    # Number of reference frames at or before each wanted time, per motion.
    low = (share[:, None, :] <= even[None, :, None] + 1e-12).sum(2) - 1
    low = low.clip(0, nref - 2)
    rows = np.arange(count)[:, None]
    start, end = share[rows, low], share[rows, low + 1]
    part = ((even - start) / (end - start)).clip(0.0, 1.0)[:, :, None]
    return (1.0 - part) * values[rows, low] + part * values[rows, low + 1]
