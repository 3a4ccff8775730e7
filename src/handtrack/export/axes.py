"""From our frames to those of animation and virtual reality: x right, y up, z backward.

The camera frame has x right, y down, z forward; the two differ by half a turn about x. Both are
right-handed, so a left hand stays a left hand.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.skeleton import BONE_PARENTS

Float = NDArray[np.float64]

UP_CAMERA = np.array([1.0, -1.0, -1.0])
"""Diagonal of the rotation from the camera frame to the frame with y up."""


def points_y_up(points: ArrayLike) -> Float:
    """Points, shape (..., 3), given in the camera frame, in the frame with y up."""
    return np.asarray(points, np.float64) * UP_CAMERA


def rotations_y_up(rotations: ArrayLike) -> Float:
    """Rotations R_camera_b, shape (..., 3, 3), as rotations from b to the frame with y up."""
    return UP_CAMERA[:, None] * np.asarray(rotations, np.float64)


def rotations_in_parents(rotations: ArrayLike) -> Float:
    """Rotations of the bones, shape (n, 16, 3, 3), each in the frame of its parent bone.

    The palm, which has none, keeps its own.
    """
    local = np.array(rotations, np.float64)
    local[:, 1:] = np.swapaxes(local[:, BONE_PARENTS[1:]], -1, -2) @ local[:, 1:]
    return local


def continuous_quats(quats: ArrayLike) -> Float:
    """Quaternions over time, shape (n, ..., 4), each with the sign that is nearer to the last."""
    quats = np.array(quats, np.float64)
    turned = np.einsum("...i,...i->...", quats[1:], quats[:-1]) < 0.0
    quats[1:] *= np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)[..., None]
    return quats


def xyzw(quats: ArrayLike) -> Float:
    """Quaternions w x y z, shape (..., 4), in the order x y z w."""
    return np.roll(np.asarray(quats, np.float64), -1, axis=-1)
