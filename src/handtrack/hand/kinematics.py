"""Forward kinematics and skinning in NumPy float64, the kernels' reference (Eq. II.8, II.9)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.model import ShapedHand, skeleton_frames
from handtrack.hand.skeleton import DISTAL_BONES, KEYPOINT_BONES, PALM_CORNERS, TIP_KEYPOINTS
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]


def bone_frames(hand: ShapedHand, pose: ArrayLike) -> tuple[Float, Float]:
    """Frames of the 16 bones in the camera frame.

    Args:
        hand: One person's hand.
        pose: Poses, shape (..., 28).

    Returns:
        Rotations R_camera_bone, shape (..., 16, 3, 3), and origins [m], shape (..., 16, 3).
    """
    pose = np.asarray(pose, np.float64)
    rotations, origins = skeleton_frames(
        hand.bone_rotations, hand.bone_origins, hand.angle_axes, pose[..., 7:]
    )
    palm = quat_to_matrix(pose[..., 3:7])[..., None, :, :]
    origins = (palm @ origins[..., None])[..., 0] + pose[..., None, :3]
    return palm @ rotations, origins


def keypoints(hand: ShapedHand, pose: ArrayLike) -> Float:
    """The 21 keypoints [m], shape (..., 21, 3), camera frame, of poses, shape (..., 28)."""
    rotations, origins = bone_frames(hand, pose)
    points = origins[..., KEYPOINT_BONES, :].copy()
    distal = rotations[..., list(DISTAL_BONES), :, :]
    points[..., list(TIP_KEYPOINTS), :] += (distal @ hand.tip_offsets[..., None])[..., 0]
    return points


def palm_centre(keypoints: ArrayLike) -> Float:
    """Middle of the palm [m], shape (..., 3): mean of the wrist and the fingers' base joints."""
    return np.asarray(keypoints, np.float64)[..., list(PALM_CORNERS), :].mean(axis=-2)


def skin(hand: ShapedHand, pose: ArrayLike) -> Float:
    """Vertices [m], shape (..., nvert, 3), camera frame, of poses, shape (..., 28) (Eq. II.9)."""
    return skin_of_frames(hand, *bone_frames(hand, pose))


def skin_of_frames(hand: ShapedHand, rotations: Float, origins: Float) -> Float:
    """Vertices [m], shape (..., nvert, 3), of what `bone_frames` gives."""
    bones = hand.weight_bones
    points = (
        np.einsum("...vkij,vkj->...vki", rotations[..., bones, :, :], hand.local_vertices)
        + origins[..., bones, :]
    )
    return np.einsum("vk,...vki->...vi", hand.weights, points)


def skin_normals(hand: ShapedHand, pose: ArrayLike) -> Float:
    """Blended unit normals, shape (..., nvert, 3), camera frame, of poses, shape (..., 28)."""
    rotations, _ = bone_frames(hand, pose)
    turned = np.einsum(
        "...vkij,vkj->...vki", rotations[..., hand.weight_bones, :, :], hand.local_normals
    )
    normals = np.einsum("vk,...vki->...vi", hand.weights, turned)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)
