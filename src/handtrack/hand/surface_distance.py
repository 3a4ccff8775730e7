"""How far points are from the surface of a triangle mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

Float = NDArray[np.float64]

_CANDIDATES = 12
"""Triangles looked at for each point, by the distance of their middles: more change next to
nothing."""


def surface_distance(points: ArrayLike, vertices: ArrayLike, faces: ArrayLike) -> Float:
    """Distances of points from a surface of small triangles of about one size.

    Args:
        points: Points [m], shape (n, 3).
        vertices: Vertices of the surface [m], shape (nvert, 3).
        faces: Its triangles, shape (nface, 3).

    Returns:
        Distances [m], shape (n,).
    """
    points = np.asarray(points, np.float64)
    triangles = np.asarray(vertices, np.float64)[np.asarray(faces)]
    _, near = KDTree(triangles.mean(axis=1)).query(points, k=min(_CANDIDATES, len(triangles)))
    near = np.reshape(near, (len(points), -1))
    repeated = np.repeat(points, near.shape[1], axis=0)
    found = closest_point(triangles[near.ravel()], repeated)
    return np.linalg.norm(found - repeated, axis=1).reshape(near.shape).min(axis=1)
