"""Depth images in colour: near is bright, one lightness step is one depth step."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError

Image = NDArray[np.uint8]

EMPTY_COLOUR = (26, 22, 20)
"""Colour of pixels without a measurement, B G R."""

_DARKEST = 0.16
"""Where on the map the far end lies: what is far stays apart from what is not measured."""


def depth_range(depth: ArrayLike, centre: float | None = None) -> tuple[float, float]:
    """Near and far end [m] of the colours for a depth image.

    Args:
        depth: Depth [m], shape (height, width), 0 = no measurement.
        centre: Distance of the hand [m]; the colours are spread around it when it is known.

    Returns:
        Near and far end [m], near < far.
    """
    if centre is not None and np.isfinite(centre) and centre > 0:
        return max(centre - 0.10, 0.02), centre + 0.20
    seen = np.asarray(depth)
    seen = seen[np.isfinite(seen) & (seen > 0)]
    if not len(seen):
        return 0.2, 1.2
    near, far = np.percentile(seen, [1.0, 95.0])
    return float(near), float(max(far, near + 0.2))


def colour_depth(depth: ArrayLike, near: float, far: float, *, grey: bool = False) -> Image:
    """Colour a depth image.

    Args:
        depth: Depth [m], shape (height, width), 0 = no measurement.
        near: Depth [m] of the brightest colour.
        far: Depth [m] from which everything has the darkest one.
        grey: Blue-grey instead of colours, as a ground to draw on.

    Returns:
        Picture, shape (height, width, 3), uint8, channels B G R.

    Raises:
        InputError: near is not before far.
    """
    if not near < far:
        raise InputError(f"near is {near} and far {far}: expected near < far")
    z = np.nan_to_num(np.asarray(depth, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    # From 255 at the near end down to the darkest level, rounded.
    fall = 255 * (1.0 - _DARKEST) / (far - near)
    levels = (255.5 + fall * near) - fall * z
    np.clip(levels, 255 * _DARKEST + 0.5, 255.0, out=levels)
    # The maps of Smith and van der Walt rise evenly in perceived lightness. Level 0 is free.
    return _paint(np.where(z > 0, levels, 0.0).astype(np.uint8), _GREYS if grey else _COLOURS)


def _paint(levels: NDArray[np.uint8], colours: Image) -> Image:
    """Colours, shape (256, 3), of levels, shape (height, width); OpenCV is quicker than NumPy."""
    return np.asarray(cv2.LUT(cv2.merge([levels] * 3), colours[None]), np.uint8)


def _with_empty(colours: Image) -> Image:
    """A map whose level 0 is the colour of pixels without a measurement."""
    colours = colours.copy()
    colours[0] = EMPTY_COLOUR
    return colours


def _greys() -> Image:
    """A map from dark to light blue-grey, shape (256, 3)."""
    ends = np.array([[38.0, 30.0, 26.0], [232.0, 224.0, 218.0]])
    return np.rint(ends[0] + np.linspace(0, 1, 256)[:, None] ** 1.15 * (ends[1] - ends[0])).astype(
        np.uint8
    )


_GREYS = _with_empty(_greys())
_RAMP = np.arange(256, dtype=np.uint8)[:, None]
_COLOURS: Image = _with_empty(
    np.asarray(cv2.applyColorMap(_RAMP, cv2.COLORMAP_MAGMA), np.uint8)[:, 0]
)
