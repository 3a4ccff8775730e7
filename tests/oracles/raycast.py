"""Ray casting of a triangle mesh through pixel centres with trimesh."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from trimesh.ray.ray_triangle import ray_triangle_id

Float = NDArray[np.float64]


class Boxes:
    """Bounding boxes of triangles with the two members of an R-tree that trimesh asks for.

    trimesh's own tree needs the package rtree, which nothing else here does; linear search will do.
    """

    def __init__(self, triangles: Float) -> None:
        self._low, self._high = triangles.min(1), triangles.max(1)
        self.bounds = np.concatenate([self._low.min(0), self._high.max(0)])

    def intersection(self, box: Iterable[float]) -> list[int]:
        """Triangles whose boxes touch the box."""
        low, high = np.asarray(list(box)).reshape(2, 3)
        touch = (self._low <= high).all(1) & (self._high >= low).all(1)
        return np.flatnonzero(touch).tolist()


def cast_rays(vertices: Float, faces: NDArray, directions: Float) -> tuple[Float, list[set[int]]]:
    """First hits of rays from the camera centre.

    Args:
        vertices: Vertices [m], camera frame, shape (nvert, 3).
        faces: Triangles, shape (nface, 3).
        directions: Ray directions with z = 1, shape (n, 3).

    Returns:
        Depth z [m] of the nearest hit, infinity for none, shape (n,); and, per ray, all triangles
        hit within 10 micrometres of it (an edge belongs to two).
    """
    triangles = vertices[faces]
    hit, ray, place = ray_triangle_id(
        triangles, np.zeros_like(directions), directions, tree=Boxes(triangles), multiple_hits=True
    )
    depth = np.full(len(directions), np.inf)
    place = place.reshape(-1, 3)
    np.minimum.at(depth, ray, place[:, 2])
    first: list[set[int]] = [set() for _ in directions]
    for triangle, r, point in zip(hit, ray, place, strict=True):
        if point[2] <= depth[r] + 1e-5:
            first[r].add(int(triangle))
    return depth, first
