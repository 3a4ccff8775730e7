"""Winding number of a closed mesh around points: 1 inside, 0 outside, 2 where it overlaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def winding_numbers(vertices: Float, faces: NDArray[np.int32], points: Float) -> Float:
    """Sum of the solid angles of all triangles over 4 pi (van Oosterom and Strackee 1983).

    Args:
        vertices: Shape (nvert, 3).
        faces: Outward counter-clockwise triangles, shape (nface, 3).
        points: Shape (n, 3).

    Returns:
        Winding numbers, shape (n,).
    """
    found = np.empty(len(points))
    for start in range(0, len(points), 64):
        part = slice(start, start + 64)
        corners = vertices[faces][None] - points[part, None, None]
        a, b, c = np.moveaxis(corners, 2, 0)
        la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
        triple = (a * np.cross(b, c)).sum(-1)
        rest = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        found[part] = 2.0 * np.arctan2(triple, rest).sum(axis=1) / (4.0 * np.pi)
    return found
