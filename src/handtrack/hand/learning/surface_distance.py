"""How far points are from the surface of a triangle mesh."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

Float = NDArray[np.float64]

_NEAR = 4
"""Vertices whose triangles are searched: the nearest vertex alone may belong to a triangle that
only comes close with its corner."""


def surface_distance(points: ArrayLike, vertices: ArrayLike, faces: ArrayLike) -> Float:
    """Distances of points from a surface.

    The triangles at the nearest vertices are searched, which is all but exact for meshes as even as
    hands and scans are.

    Args:
        points: Points [m], shape (n, 3).
        vertices: Vertices of the surface [m], shape (nvert, 3).
        faces: Its triangles, shape (nface, 3).

    Returns:
        Distances [m], shape (n,).
    """
    points, vertices = np.asarray(points, np.float64), np.asarray(vertices, np.float64)
    faces = np.asarray(faces)
    used = np.unique(faces)
    order = np.argsort(faces.ravel(), kind="stable")
    first = np.searchsorted(faces.ravel()[order], np.arange(len(vertices) + 1))
    near = used[KDTree(vertices[used]).query(points, k=min(_NEAR, len(used)))[1]]
    near = near.reshape(len(points), -1)
    counts = np.diff(first)[near]
    flat = counts.ravel()
    within = np.arange(flat.sum()) - np.repeat(np.cumsum(flat) - flat, flat)
    triangles = order[np.repeat(first[near.ravel()], flat) + within] // 3
    owners = np.repeat(np.arange(len(points)), counts.sum(axis=1))
    closest = trimesh.triangles.closest_point(vertices[faces[triangles]], points[owners])
    distances = np.linalg.norm(closest - points[owners], axis=1)
    starts = np.searchsorted(owners, np.arange(len(points)))
    return np.minimum.reduceat(distances, starts)
