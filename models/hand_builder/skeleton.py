"""Bone frames, joint axes and rest angles of the template (thesis II.3.1), and poses of subjects.

Each finger bends in one plane. Where the plane lies is decided on the template: the rest roll of a
finger follows its nail, the zero direction follows its metacarpal, so that bent fingers converge
towards the scaphoid. The thumb's plane is the one in which the template's thumb is bent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from handtrack.hand.model import skeleton_frames
from handtrack.hand.skeleton import (
    ANGLE_BONES,
    ANGLES,
    BASE_BONES,
    BONE_PARENTS,
    DISTAL_BONES,
    NANGLE,
    NBONE,
)

Float = NDArray[np.float64]

FINGER_ROLL = np.radians([9.0, 0.0, -4.0, -13.0])
"""Turn of index..little about their own axis at rest; positive: the pad looks to the ulnar side.
Between the nails of the template and the planes in which recorded fingers bend."""

ZERO_AZIMUTH = np.radians([9.0, -1.0, -9.0, -17.0])
"""Direction of the straight index..little in the palm plane at zero angles, from x towards z:
the directions of their metacarpals."""

THUMB_REST_ABDUCTION = np.radians(30.0)
"""Trapeziometacarpal abduction of the template: at zero the metacarpal lies in the palm plane."""

ABDUCTION_SIGN: dict[str, float] = {
    "thumb": -1.0, "index": -1.0, "middle": -1.0, "ring": 1.0, "little": 1.0,
}  # fmt: skip
"""Sign of y in the abduction axis, so that positive angles move away from the middle finger
(middle: to the thumb side; thumb: out of the palm)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Skeleton:
    """Zero-angle frames and joint axes, common to all subjects, and the template's rest angles."""

    bone_rotations: Float
    """R_parent_bone at zero angles, shape (16, 3, 3)."""
    dof_axes: Float
    """Axis of each angle in its bone's frame, shape (21, 3)."""
    rest_angles: Float
    """Angles of the template [rad], shape (21,)."""


def dof_axes() -> Float:
    """Axes of the 21 angles in their bones' frames: z flexes, +-y abducts."""
    axes = np.zeros((NANGLE, 3))
    for k, name in enumerate(ANGLES):
        finger = name.split("_")[0]
        if name.endswith("abduction"):
            axes[k, 1] = ABDUCTION_SIGN[finger]
        else:
            axes[k, 2] = 1.0
    return axes


def template_skeleton(keypoints: Float) -> Skeleton:
    """Frames and rest angles from the template's keypoints in the palm frame, shape (21, 3)."""
    rotations = np.tile(np.eye(3), (NBONE, 1, 1))
    for finger in range(1, 5):
        mcp, pip = keypoints[1 + 4 * finger : 3 + 4 * finger]
        rest = _roll_about(_unit(pip - mcp), FINGER_ROLL[finger - 1])
        sign = (-1.0, -1.0, 1.0, 1.0)[finger - 1]
        rotations[BASE_BONES[finger]] = _zero_frame(rest, sign, ZERO_AZIMUTH[finger - 1])
    rotations[1] = _thumb_frame(keypoints[1:5])
    axes = dof_axes()
    return Skeleton(
        bone_rotations=rotations, dof_axes=axes, rest_angles=fit_pose(keypoints, rotations)
    )


def fit_pose(keypoints: Float, bone_rotations: Float) -> Float:
    """Angles that bring the joints nearest to keypoints given in the palm frame.

    Base joints and bone lengths are those of the keypoints. What remains, at most about a
    millimetre, is how far a finger's joints lie off one plane.

    Args:
        keypoints: Keypoints [m], shape (21, 3), palm frame.
        bone_rotations: R_parent_bone at zero angles, shape (16, 3, 3).

    Returns:
        Joint angles [rad], shape (21,).
    """
    axes = dof_axes()
    origins, tips = bone_origins(keypoints)

    def joints(angles: Float) -> Float:
        turned, placed = skeleton_frames(bone_rotations, origins, axes, angles)
        distal = list(DISTAL_BONES)
        ends = placed[..., distal, :] + (turned[..., distal, :, :] @ tips[..., None])[..., 0]
        return np.concatenate([placed[..., 1:, :], ends], axis=-2).reshape(*angles.shape[:-1], -1)

    starts = [1 + 4 * finger + segment for finger in range(5) for segment in range(3)]
    goal = keypoints[starts + [4 + 4 * finger for finger in range(5)]].ravel()
    angles = initial_pose(keypoints, bone_rotations)
    step = 1e-6
    for _ in range(8):
        nudged = np.vstack([angles + step * np.eye(NANGLE), angles - step * np.eye(NANGLE)])
        moved = joints(nudged)
        jacobian = ((moved[:NANGLE] - moved[NANGLE:]) / (2 * step)).T
        change = np.linalg.lstsq(jacobian, goal - joints(angles), rcond=None)[0]
        angles = angles + change
        if np.abs(change).max() < 1e-10:
            break
    return angles


def initial_pose(keypoints: Float, bone_rotations: Float) -> Float:
    """Angles that point the bones along keypoints given in the palm frame, one bone at a time.

    The first bone of a finger gets its exact direction; a hinge gets the direction nearest to its
    plane.

    Args:
        keypoints: Keypoints [m], shape (21, 3), palm frame.
        bone_rotations: R_parent_bone at zero angles, shape (16, 3, 3).

    Returns:
        Joint angles [rad], shape (21,).
    """
    axes = dof_axes()
    angles = np.zeros(NANGLE)
    frames = np.tile(np.eye(3), (NBONE, 1, 1))
    for bone in range(1, NBONE):
        finger, segment = divmod(bone - 1, 3)
        start = 1 + 4 * finger + segment
        direction = _unit(keypoints[start + 1] - keypoints[start])
        zero = frames[BONE_PARENTS[bone]] @ bone_rotations[bone]
        local = zero.T @ direction
        dofs = [k for k, b in enumerate(ANGLE_BONES) if b == bone]
        angles[dofs[0]] = np.arctan2(local[1], local[0])
        if len(dofs) == 2:
            angles[dofs[1]] = np.arcsin(np.clip(-axes[dofs[1], 1] * local[2], -1, 1))
        turn = np.eye(3)
        for k in dofs:
            turn = turn @ Rotation.from_rotvec(angles[k] * axes[k]).as_matrix()
        frames[bone] = zero @ turn
    return angles


def bone_lengths(keypoints: Float) -> Float:
    """Length of each bone [m], shape (16,), to the next joint or tip; palm: wrist to middle MCP."""
    lengths = np.empty(NBONE)
    lengths[0] = np.linalg.norm(keypoints[9] - keypoints[0])
    for bone in range(1, NBONE):
        finger, segment = divmod(bone - 1, 3)
        start = 1 + 4 * finger + segment
        lengths[bone] = np.linalg.norm(keypoints[start + 1] - keypoints[start])
    return lengths


def bone_origins(keypoints: Float) -> tuple[Float, Float]:
    """Joint origins in the parents' frames, shape (16, 3), and tip offsets, shape (5, 3)."""
    lengths = bone_lengths(keypoints)
    origins = np.zeros((NBONE, 3))
    for bone in range(1, NBONE):
        if bone in BASE_BONES:
            origins[bone] = keypoints[1 + 4 * BASE_BONES.index(bone)]
        else:
            origins[bone, 0] = lengths[BONE_PARENTS[bone]]
    tips = np.zeros((5, 3))
    tips[:, 0] = lengths[list(DISTAL_BONES)]
    return origins, tips


def _unit(v: Float) -> Float:
    return v / np.linalg.norm(v)


def _roll_about(x: Float, roll: float) -> Float:
    """Frame with the given x, its y palmar, turned about x by `roll`."""
    z = _unit(np.array([0.0, 0.0, 1.0]) - x[2] * x)
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    return frame @ Rotation.from_euler("x", -roll).as_matrix()


def _zero_frame(rest: Float, sign: float, azimuth: float) -> Float:
    """Zero frame R0 with rest = R0 Rz(f) Ry(sign a) whose x lies in the palm plane at `azimuth`."""

    def zero(angles: Float) -> Float:
        turn = Rotation.from_euler("ZY", [angles[0], sign * angles[1]]).as_matrix()
        return rest @ turn.T

    def miss(angles: Float) -> Float:
        x = zero(angles)[:, 0]
        return np.array([x[1], np.arctan2(x[2], x[0]) - azimuth])

    solution = root(miss, np.array([0.3, 0.1]))
    if not solution.success:
        raise ValueError(f"no zero frame at azimuth {azimuth}: {solution.message}")
    return zero(solution.x)


def _thumb_frame(keypoints: Float) -> Float:
    """Zero frame of the thumb's metacarpal from its four keypoints.

    The roll is chosen so that the interphalangeal joint bends about z; the zero lies
    `THUMB_REST_ABDUCTION` below the rest direction about y.
    """
    first, second, third = (_unit(d) for d in np.diff(keypoints, axis=0))
    bend = _unit(np.cross(second, third))

    def frame(roll: float) -> Float:
        z = _unit(bend - (bend @ first) * first)
        return (
            np.stack([first, np.cross(z, first), z], axis=1)
            @ Rotation.from_euler("x", roll).as_matrix()
        )

    def miss(roll: Float) -> Float:
        rest = frame(float(roll[0]))
        local = rest.T @ second
        sign = ABDUCTION_SIGN["thumb"]
        angles = [np.arctan2(local[1], local[0]), sign * np.arcsin(-sign * local[2])]
        proximal = rest @ Rotation.from_euler("ZY", angles).as_matrix()
        return np.array([(proximal.T @ third)[2]])

    rest = frame(float(root(miss, np.zeros(1)).x[0]))
    sign = ABDUCTION_SIGN["thumb"]
    return rest @ Rotation.from_euler("y", sign * THUMB_REST_ABDUCTION).as_matrix().T
