"""Rotations and rigid transforms in NumPy float64: quaternions are w first, `T_a_b` maps b to a."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Float = NDArray[np.float64]


def quat_to_matrix(quat: ArrayLike) -> Float:
    """Rotation matrices of unit quaternions.

    Args:
        quat: Quaternions w x y z, shape (..., 4); need not be normalised.

    Returns:
        Rotation matrices, shape (..., 3, 3).
    """
    q = np.asarray(quat, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def matrix_to_quat(matrix: ArrayLike) -> Float:
    """Unit quaternions w x y z, w >= 0, shape (..., 4), of matrices, shape (..., 3, 3)."""
    m = np.asarray(matrix, np.float64)
    quat = Rotation.from_matrix(m.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True)
    return quat.reshape(*m.shape[:-2], 4)


def rotvec_to_matrix(rotvec: ArrayLike) -> Float:
    """Rotation matrices, shape (..., 3, 3), of rotation vectors [rad], shape (..., 3)."""
    v = np.asarray(rotvec, np.float64)
    return Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix().reshape(*v.shape[:-1], 3, 3)


def matrix_to_rotvec(matrix: ArrayLike) -> Float:
    """Rotation vectors [rad], shape (..., 3), of rotation matrices, shape (..., 3, 3)."""
    m = np.asarray(matrix, np.float64)
    rotvec = Rotation.from_matrix(m.reshape(-1, 3, 3)).as_rotvec()
    return rotvec.reshape(*m.shape[:-2], 3)


_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).reshape(3, 9)


def cross_matrix(vectors: Float) -> Float:
    """Matrices M, shape (..., 3, 3), with b @ M = a x b for vectors a, shape (..., 3).

    np.cross takes ten times as long over a few rows.
    """
    return (vectors @ _CROSS).reshape(*vectors.shape, 3)


def _quat_product(a: Float, b: Float) -> Float:
    """Products of quaternions w x y z, shape (..., 4), of either sign the one with w >= 0."""
    w, u = a[..., :1], a[..., 1:]
    real = w * b[..., :1] - (u * b[..., 1:]).sum(-1, keepdims=True)
    crossed = (b[..., None, 1:] @ cross_matrix(u))[..., 0, :]
    product = np.concatenate([real, w * b[..., 1:] + b[..., :1] * u + crossed], -1)
    return product * np.where(real < 0.0, -1.0, 1.0)


def apply_increment(pose: ArrayLike, increment: ArrayLike) -> Float:
    """Move poses along the manifold: translation and angles add, rotation is q * exp(w).

    Args:
        pose: Poses, shape (..., 28).
        increment: Increments, shape (..., 27): translation [m] in the camera frame, rotation
            vector [rad] in the palm frame, joint angles [rad] (the layout of MuJoCo's qvel).

    Returns:
        New poses, shape (..., 28), with unit quaternions.
    """
    pose, dq = np.asarray(pose, np.float64), np.asarray(increment, np.float64)
    turn = dq[..., 3:6]
    half = 0.5 * np.sqrt((turn * turn).sum(-1, keepdims=True))
    # sin(half) / half, which is sinc's, stays exact where the turn is none.
    exp = np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * turn], -1)
    quat = _quat_product(pose[..., 3:7], exp)
    quat /= np.sqrt((quat * quat).sum(-1, keepdims=True))
    return np.concatenate([pose[..., :3] + dq[..., :3], quat, pose[..., 7:] + dq[..., 6:]], -1)


def moved_poses(poses: ArrayLike, rotation: ArrayLike, translation: ArrayLike = 0.0) -> Float:
    """Poses moved as one body: places are turned and shifted, orientations turned.

    Args:
        poses: Place [m], quaternion, and what stays, such as joint angles, shape (..., 7 or more).
        rotation: Rotation, shape (..., 3, 3).
        translation: Shift after the rotation [m], shape (..., 3).

    Returns:
        Poses, shape (..., n), with unit quaternions.
    """
    poses, turn = np.asarray(poses, np.float64), np.asarray(rotation, np.float64)
    place = (turn @ poses[..., :3, None])[..., 0] + np.asarray(translation, np.float64)
    quat = matrix_to_quat(turn @ quat_to_matrix(poses[..., 3:7]))
    rest = np.broadcast_to(poses[..., 7:], (*quat.shape[:-1], poses.shape[-1] - 7))
    return np.concatenate([place, quat, rest], axis=-1)


def pose_difference(pose: ArrayLike, reference: ArrayLike) -> Float:
    """Increment from `reference` to `pose`, shape (..., 27): the inverse of `apply_increment`."""
    a, b = np.asarray(pose, np.float64), np.asarray(reference, np.float64)
    back = b[..., 3:7] * np.array([1.0, -1.0, -1.0, -1.0])
    relative = _quat_product(back, a[..., 3:7])
    sine = np.sqrt((relative[..., 1:] ** 2).sum(-1, keepdims=True))
    half = np.arctan2(sine, relative[..., :1])
    # Quaternions need not be normalised; where the turn is none, so is their imaginary part.
    turn = 2.0 * relative[..., 1:] * (half / np.maximum(sine, np.finfo(np.float64).tiny))
    return np.concatenate([a[..., :3] - b[..., :3], turn, a[..., 7:] - b[..., 7:]], -1)
