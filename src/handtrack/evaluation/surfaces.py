"""Distance between the surfaces of two hands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand

Float = NDArray[np.float64]

_CANDIDATES = 12
"""Triangles looked at for each point, by the distance of their middles: more change nothing."""


def distances_to_surface(points: Float, vertices: Float, faces: NDArray[np.int32]) -> Float:
    """Distance of points from a surface of small triangles of about one size [m], shape (n,).

    Args:
        points: Points [m], shape (n, 3).
        vertices: Vertices of the surface [m], shape (nvert, 3).
        faces: Its triangles, shape (nface, 3).
    """
    triangles = vertices[faces]
    _, near = KDTree(triangles.mean(axis=1)).query(points, k=min(_CANDIDATES, len(faces)))
    near = near.reshape(len(points), -1)
    repeated = np.repeat(points, near.shape[1], axis=0)
    found = closest_point(triangles[near.ravel()], repeated)
    return np.linalg.norm(found - repeated, axis=1).reshape(near.shape).min(axis=1)


def rest_surface_distance(first: ShapedHand, second: ShapedHand) -> float:
    """Mean distance between two hands' skins without forearm, both ways, in the rest pose [m].

    Palm frames and joint angles are the same; nothing is aligned beyond that.
    """
    pose = np.zeros(28)
    pose[3] = 1.0
    pose[7:] = first.rest_angles
    skins = [skin(hand, pose) for hand in (first, second)]
    distances = [
        distances_to_surface(skins[k][~hand.stub_vertices], skins[1 - k], hand.faces).mean()
        for k, hand in enumerate((first, second))
    ]
    return float(np.mean(distances))
