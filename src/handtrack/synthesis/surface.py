"""Geometry of surfaces in a depth image: their slant, their edges, and moving those edges.

What sensor noise depends on; depths in metres, 0 = nothing there, pixels as in
`handtrack.camera.camera`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera

Depth = NDArray[np.float32]

MIN_STEP_M = 0.01
"""Depth difference [m] between neighbouring pixels that makes an edge, beside the slope rule of
`edge_step`."""

EDGE_SLOPE = math.tan(math.radians(82.0))
"""Steeper than this [m per m] between neighbouring pixels is an edge, not a slanted surface."""

_NEIGHBOURS: tuple[tuple[int, int], ...] = ((0, -1), (0, 1), (-1, 0), (1, 0))


def surface_slant(depth: ArrayLike, camera: Camera) -> Depth:
    """Angle between the surface normal and the optical axis at every pixel.

    Derivatives are taken towards the neighbour with the smaller depth difference, so they do not
    reach across edges.

    Args:
        depth: Depth [m], shape (..., height, width), 0 = nothing.
        camera: Camera of the images.

    Returns:
        Slant [rad], shape (..., height, width), float32, in [0, pi/2); 0 where there is nothing.
    """
    z = np.asarray(depth, dtype=np.float32)
    zu = _small_difference(z, axis=-1)
    zv = _small_difference(z, axis=-2)
    # For the surface z(u, v): normal = (fx zu, fy zv, -(z + (u - cx) zu + (v - cy) zv)) up to a
    # factor.
    u = (np.arange(camera.width) - camera.cx).astype(np.float32)
    v = (np.arange(camera.height) - camera.cy).astype(np.float32)[:, None]
    across = np.hypot(camera.fx * zu, camera.fy * zv)
    along = np.abs(z + u * zu + v * zv)
    slant = np.arctan2(across, np.maximum(along, np.float32(1e-9)))
    return np.where(z > 0.0, slant, 0.0).astype(np.float32)


def _small_difference(z: Depth, axis: int) -> Depth:
    """Depth difference to the next pixel along an axis, the smaller one of both sides."""
    step = np.diff(z, axis=axis)
    both = np.minimum(np.delete(z, -1, axis), np.delete(z, 0, axis)) > 0.0
    step = np.where(both, step, np.inf)
    ends = [(0, 0)] * z.ndim
    ends[axis] = (0, 1)
    after = np.pad(step, ends, constant_values=np.inf)
    ends[axis] = (1, 0)
    before = np.pad(step, ends, constant_values=np.inf)
    smaller = np.where(np.abs(after) < np.abs(before), after, before)
    return np.where(np.isfinite(smaller), smaller, 0.0).astype(np.float32)


def edge_step(depth: NDArray[np.floating], camera: Camera) -> Depth:
    """Depth difference [m] from which neighbouring pixels lie on different surfaces."""
    return np.float32(MIN_STEP_M) + depth * np.float32(EDGE_SLOPE / camera.fx)


def edge_pixels(depth: Depth, camera: Camera) -> NDArray[np.bool_]:
    """Pixels on the near side of a depth edge: a neighbour lies farther behind or is empty."""
    limit = depth + edge_step(depth, camera)
    edges = np.zeros(depth.shape, bool)
    for dv, du in _NEIGHBOURS:
        beside = _shifted(depth, dv, du)
        edges |= (beside > limit) | (beside == 0.0)
    return edges & (depth > 0.0)


def _shifted(image: NDArray[Any], dv: int, du: int) -> NDArray[Any]:
    """Value of the neighbour at (v + dv, u + du), the border repeated, shape as given."""
    height, width = image.shape[-2:]
    rows = np.clip(np.arange(height) + dv, 0, height - 1)
    columns = np.clip(np.arange(width) + du, 0, width - 1)
    return image[..., rows[:, None], columns]


def farthest_nearby(depth: Depth) -> Depth:
    """Largest depth of a pixel and its four neighbours."""
    return np.maximum.reduce([depth, *(_shifted(depth, dv, du) for dv, du in _NEIGHBOURS)])


def move_silhouettes(
    depth: Depth, slant: Depth, width: float, camera: Camera, rng: np.random.Generator
) -> tuple[Depth, Depth]:
    """Move silhouettes outwards by a width [pixels], inwards where it is negative.

    A part of a pixel is a share of the edge's pixels, picked at random.
    """
    outwards = width > 0.0
    for step in range(math.ceil(abs(width))):
        chosen = rng.random(depth.shape, dtype=np.float32) < min(abs(width) - step, 1.0)
        best = depth.copy()
        steep = slant.copy()
        for dv, du in _NEIGHBOURS:
            beside = _shifted(depth, dv, du)
            # Inwards, the near surface gives way to what is behind it; outwards, it spreads over
            # that.
            gap = edge_step(np.maximum(depth, beside), camera)
            grows = (beside > 0.0) & ((depth == 0.0) | (depth - beside > gap))
            shrinks = (depth > 0.0) & ((beside == 0.0) | (beside - depth > gap))
            take = chosen & (grows if outwards else shrinks)
            best = np.where(take, beside, best)
            steep = np.where(take, _shifted(slant, dv, du), steep)
        depth, slant = best, steep
    return depth, slant
