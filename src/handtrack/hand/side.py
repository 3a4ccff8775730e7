"""The one mirror rule: a left hand is the mirror image of a right hand in the palm's x-y plane.

With M = diag(1, 1, -1) in the palm frame (z is radial), points map to M p, rotations to M R M and
joint axes, being pseudovectors, to -M a, so that every joint angle keeps its value and its meaning.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.transforms import matrix_to_quat, quat_to_matrix

Side = Literal["right", "left"]

MIRROR = np.array([1.0, 1.0, -1.0])
"""Diagonal of the mirror matrix in the palm frame and in every bone frame."""


def check_side(side: str) -> Side:
    """Return `side` when it is "right" or "left".

    Raises:
        InputError: `side` is anything else.
    """
    if side not in ("right", "left"):
        raise InputError(f"side is {side!r}; expected 'right' or 'left'")
    return side  # type: ignore[return-value]


def mirror_points(points: ArrayLike) -> NDArray[np.float64]:
    """Mirror points or free vectors, shape (..., 3)."""
    return np.asarray(points, np.float64) * MIRROR


def mirror_axes(axes: ArrayLike) -> NDArray[np.float64]:
    """Mirror rotation axes, shape (..., 3)."""
    return -np.asarray(axes, np.float64) * MIRROR


def mirror_rotations(rotations: ArrayLike) -> NDArray[np.float64]:
    """Mirror rotation matrices, shape (..., 3, 3)."""
    return np.asarray(rotations, np.float64) * MIRROR[:, None] * MIRROR[None, :]


def mirror_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """Pose of the other hand whose picture is this hand's picture mirrored left to right.

    Camera x changes sign: the translation's x flips, the rotation becomes diag(-1,1,1) R M and the
    joint angles stay.

    Args:
        pose: Poses, shape (..., 28).

    Returns:
        Mirrored poses, shape (..., 28).
    """
    pose = np.asarray(pose, np.float64)
    flip = np.array([-1.0, 1.0, 1.0])
    rotation = quat_to_matrix(pose[..., 3:7]) * flip[:, None] * MIRROR[None, :]
    return np.concatenate([pose[..., :3] * flip, matrix_to_quat(rotation), pose[..., 7:]], axis=-1)
