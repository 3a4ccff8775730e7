"""Inverse kinematics in NumPy: poses that put chosen points where they belong, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import (
    ANGLE_BONES,
    BONE_ANGLES,
    KEYPOINT_BONES,
    NANGLE,
    NBONE,
    NKEYPOINT,
    NV,
    PALM_CORNERS,
    TIP_KEYPOINTS,
    finger_of_bone,
)
from handtrack.transforms import apply_increment, cross_matrix, matrix_to_quat

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class BonePoints:
    """Points fixed to bones, such as keypoints or a data set's joints."""

    bones: NDArray[np.int64]
    """Bone of each point, shape (npoint,)."""
    offsets: Float
    """Place of each point in its bone's frame [m], shape (npoint, 3)."""

    @classmethod
    def of_keypoints(cls, hand: ShapedHand) -> BonePoints:
        """The 21 keypoints."""
        offsets = np.zeros((NKEYPOINT, 3))
        offsets[list(TIP_KEYPOINTS)] = hand.tip_offsets
        return cls(bones=KEYPOINT_BONES.copy(), offsets=offsets)

    @classmethod
    def of_skin(cls, hand: ShapedHand, chosen: ArrayLike) -> BonePoints:
        """Vertices of the skin, numbers `chosen` (npoint,), on the bone that moves each most."""
        chosen = np.asarray(chosen)
        slots = hand.weights[chosen].argmax(1)
        return cls(
            bones=hand.weight_bones[chosen, slots].astype(np.int64),
            offsets=hand.local_vertices[chosen, slots],
        )

    def place(self, hand: ShapedHand, pose: ArrayLike) -> Float:
        """The points [m], camera frame, shape (..., npoint, 3), of poses, shape (..., 28)."""
        rotations, origins = bone_frames(hand, pose)
        turned = rotations[..., self.bones, :, :] @ self.offsets[..., None]
        return origins[..., self.bones, :] + turned[..., 0]


def _moves() -> NDArray[np.bool_]:
    """Which joint angle moves which bone, shape (16, 21)."""
    moves = np.zeros((NBONE, NANGLE), bool)
    for angle, first in enumerate(ANGLE_BONES):
        for bone in range(first, NBONE):
            moves[bone, angle] = finger_of_bone(bone) == finger_of_bone(first)
    return moves


_TURNS = np.concatenate([np.ones((NBONE, 3), bool), _moves()], axis=1)
"""Which of the palm's three turns and of the joint angles move which bone, shape (16, 24)."""

_OUTER, _INNER = BONE_ANGLES[BONE_ANGLES[:, 1] >= 0].T
"""Angles of the bones that have two."""


def point_jacobian(hand: ShapedHand, points: BonePoints, pose: ArrayLike) -> tuple[Float, Float]:
    """Points and their derivative by the increment.

    Args:
        hand: One person's hand.
        points: Points on its bones.
        pose: Poses, shape (n, 28).

    Returns:
        Points [m], shape (n, npoint, 3), and derivatives, shape (n, npoint, 3, 27).
    """
    rotations, origins = bone_frames(hand, pose)
    turned = rotations[:, points.bones] @ points.offsets[..., None]
    placed = origins[:, points.bones] + turned[..., 0]
    bones = np.broadcast_to(points.bones, placed.shape[:2])
    return placed, jacobian_of_frames(
        hand, np.asarray(pose, np.float64), rotations, origins, bones, placed
    )


def jacobian_of_frames(
    hand: ShapedHand, pose: Float, rotations: Float, origins: Float, bones: NDArray, placed: Float
) -> Float:
    """Derivative by the increment of points that may sit on other bones in every pose.

    Args:
        hand: One person's hand.
        pose: Poses, shape (n, 28).
        rotations: Their bones' rotations, shape (n, 16, 3, 3).
        origins: Their bones' origins [m], shape (n, 16, 3).
        bones: Bone of each point, shape (n, npoint).
        placed: The points where they are [m], shape (n, npoint, 3).

    Returns:
        Derivatives, shape (n, npoint, 3, 27).
    """
    # A turn about an axis a through o moves a point p by a x p - a x o, which is linear in p.
    # Palm frame turn w: d p = R (w x (p - t)), so its axes are R's columns through t.
    axes = np.concatenate(
        [np.swapaxes(rotations[:, 0], 1, 2), _angle_axes(hand, rotations, pose)], axis=1
    )
    centres = np.concatenate(
        [np.repeat(origins[:, :1], 3, axis=1), origins[:, list(ANGLE_BONES)]], axis=1
    )
    turn = np.moveaxis(cross_matrix(axes), 1, 3)  # (n, from, to, axis)
    still = np.einsum("nkf,nftk->ntk", centres, turn)
    moved = (placed @ turn.reshape(len(turn), 3, -1)).reshape(*placed.shape, -1)
    jacobian = np.zeros((*placed.shape, NV))
    jacobian[..., :3] = np.eye(3)
    np.multiply(moved - still[:, None], _TURNS[bones][..., None, :], out=jacobian[..., 3:])
    return jacobian


def _angle_axes(hand: ShapedHand, rotations: Float, pose: Float) -> Float:
    """World axes of the joint angles, shape (n, 21, 3); inner angles do not turn outer axes."""
    own = np.broadcast_to(hand.angle_axes, (len(pose), NANGLE, 3)).copy()
    # Undo the inner rotation: R = R_outer Rot(inner), and Rot(-inner) acts in the bone frame.
    inner, outer = hand.angle_axes[_INNER], hand.angle_axes[_OUTER]
    angle = -pose[:, 7 + _INNER, None]
    along = inner * (inner * outer).sum(1, keepdims=True)
    own[:, _OUTER] = (
        along + np.cos(angle) * (outer - along) + np.sin(angle) * np.cross(inner, outer)
    )
    return (rotations[:, list(ANGLE_BONES)] @ own[..., None])[..., 0]


def initial_pose(hand: ShapedHand, targets: ArrayLike) -> Float:
    """Poses at the rest angles, palm laid on the wrist and knuckles of the 21 target keypoints.

    Args:
        hand: One person's hand.
        targets: Keypoints [m], shape (n, 21, 3).

    Returns:
        Poses, shape (n, 28).
    """
    targets = np.asarray(targets, np.float64)
    rest = np.zeros(28)
    rest[3], rest[7:] = 1.0, hand.rest_angles
    palm = list(PALM_CORNERS)
    source = keypoints(hand, rest)[palm]
    goal = targets[:, palm]
    a = source - source.mean(0)
    b = goal - goal.mean(1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("npi,pj->nij", b, a))
    flip = np.ones((len(goal), 3))
    flip[:, 2] = np.linalg.det(u @ vt)
    rotation = (u * flip[:, None]) @ vt
    pose = np.tile(rest, (len(goal), 1))
    pose[:, :3] = goal.mean(1) - (rotation @ source.mean(0))
    pose[:, 3:7] = matrix_to_quat(rotation)
    return pose


def solve_poses(
    hand: ShapedHand,
    points: BonePoints,
    targets: ArrayLike,
    start: ArrayLike,
    *,
    iterations: int = 60,
    limit_weight: float = 1.0,
    rest_weight: float = 1e-5,
) -> Float:
    """Poses that bring the points to their targets, by damped Gauss-Newton on all frames at once.

    Args:
        hand: One person's hand.
        points: Points on its bones.
        targets: Where they should be [m], camera frame, shape (n, npoint, 3); NaN leaves one out.
        start: Start poses, shape (n, 28).
        iterations: Gauss-Newton steps.
        limit_weight: Weight of squared excess over a joint limit [m^2/rad^2].
        rest_weight: Weight of squared departure from the rest angles [m^2/rad^2]; settles
            angles that
            the points leave open.

    Returns:
        Poses, shape (n, 28).

    Raises:
        InputError: Shapes do not fit.
    """
    targets, pose = np.asarray(targets, np.float64), np.array(start, np.float64)
    if targets.shape != (len(pose), len(points.bones), 3):
        raise InputError(
            f"targets have shape {targets.shape}; expected {(len(pose), len(points.bones), 3)}"
        )
    known: NDArray[np.bool_] = np.asarray(np.isfinite(targets).all(-1))
    goal = np.where(known[..., None], targets, 0.0)
    low, high = hand.limits.T
    damping = np.full(len(pose), 1e-3)
    energy = np.full(len(pose), np.inf)
    best = pose.copy()
    system, slope = np.zeros((len(pose), NV, NV)), np.zeros((len(pose), NV))
    for _ in range(iterations):
        placed, jacobian = point_jacobian(hand, points, pose)
        residual = np.where(known[..., None], placed - goal, 0.0)
        jacobian *= known[..., None, None]
        over = np.minimum(pose[:, 7:] - low, 0) + np.maximum(pose[:, 7:] - high, 0)
        away = pose[:, 7:] - hand.rest_angles
        tried = (
            (residual**2).sum((1, 2)) + limit_weight * (over**2).sum(1)
            + rest_weight * (away**2).sum(1)
        )  # fmt: skip
        flat = jacobian.reshape(len(pose), -1, NV)
        hessian = np.swapaxes(flat, 1, 2) @ flat
        gradient = (np.swapaxes(flat, 1, 2) @ residual.reshape(len(pose), -1, 1))[..., 0]
        index = np.arange(6, NV)
        hessian[:, index, index] += limit_weight * (over != 0) + rest_weight
        gradient[:, 6:] += limit_weight * over + rest_weight * away

        better: NDArray[np.bool_] = np.asarray(tried < energy)
        system[better], slope[better] = hessian[better], gradient[better]
        best[better], energy[better] = pose[better], tried[better]
        damping = np.clip(np.where(better, damping * 0.3, damping * 8), 1e-9, 1e3)
        damped = system.copy()
        diagonal = np.arange(NV)
        damped[:, diagonal, diagonal] *= 1 + damping[:, None]
        damped[:, diagonal, diagonal] += 1e-9
        step = -np.linalg.solve(damped, slope[..., None])[..., 0]
        step /= np.maximum(np.abs(step).max(1, keepdims=True) / 0.5, 1.0)
        pose = apply_increment(best, step)
    return best
