"""Depth error E_d (thesis Eq. II.19): mean depth difference over the union of both hands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def depth_error(
    rendered: Float,
    cells: Float,
    points: Float,
    palm: tuple[Float, Float],
    *,
    scale: int,
    cap: float,
    wrist_x: float,
) -> tuple[float, int]:
    """E_d [m] with every pixel's difference capped, and the number of pixels in the union.

    Args:
        rendered: Rendered depth [m], 0 = nothing drawn, shape (m, m).
        cells: Observed z [m], 0 background, infinity unknown, shape (m * scale, m * scale).
        points: Observed points [m], shape (m * scale, m * scale, 3).
        palm: Rotation and origin of the palm, camera frame.
        scale: Cells per rendered pixel.
        cap: Largest difference counted [m], and the error where nothing can be compared.
        wrist_x: Observed points behind this palm-frame x are the forearm's and not compared [m].
    """
    seen = cells[::scale, ::scale]
    in_palm = (points[::scale, ::scale] - palm[1]) @ palm[0]
    known = np.isfinite(seen)
    forearm = (seen > 0) & ~(in_palm[..., 0] >= wrist_x)
    union = known & ~forearm & ((rendered > 0) | (seen > 0))
    with np.errstate(invalid="ignore"):
        both = (rendered > 0) & (seen > 0)
        difference = np.where(both, np.minimum(np.abs(rendered - seen), cap), cap)
    count = int(union.sum())
    return (float(difference[union].mean()) if count else cap), count
