"""Small scenes that several tests share: hands, cameras and poses seen by a camera."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

Float = NDArray[np.float64]

SMALL_CAMERA = Camera(width=160, height=120, fx=121.0, fy=119.5, cx=79.5, cy=60.25)
"""A quarter of the pixels of a 320x240 camera with the same view, not quite square pixels."""

PALM_TO_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Fingers up, palm towards the camera, thumb side right."""


@cache
def hand_model() -> HandModel:
    """The model that comes with handtrack, read once."""
    return HandModel.load()


@cache
def shaped_hand(side: str = "right", seed: int = 0) -> ShapedHand:
    """A person's hand: the mean hand for seed 0, else a random one."""
    model = hand_model()
    shape = model.sample_shape(np.random.default_rng(seed)) if seed else None
    return model.shaped(shape, side=side)


def within_limits(hand: ShapedHand, rng: np.random.Generator, count: int) -> Float:
    """Random joint angles inside the limits [rad], shape (count, 21)."""
    low, high = hand.limits.T
    return low + (high - low) * rng.uniform(0.05, 0.95, (count, len(low)))


def seen_poses(
    hand: ShapedHand,
    rng: np.random.Generator,
    count: int,
    *,
    distance: float = 0.45,
    turn: float = 0.5,
    bend: float = 0.5,
) -> Float:
    """Poses in the middle of the view, palm more or less towards the camera.

    Args:
        hand: The hand.
        rng: Random numbers.
        count: Number of poses.
        distance: Of the hand's middle [m].
        turn: Standard deviation of the palm's rotation [rad].
        bend: How far joint angles go from rest towards a random pose, 0 to 1.

    Returns:
        Poses, shape (count, 28).
    """
    poses = np.zeros((count, 28))
    facing = PALM_TO_CAMERA
    if hand.side == "left":
        # The mirror image of the right hand's view turns the camera's x and the palm's z over.
        facing = np.diag([-1.0, 1.0, 1.0]) @ PALM_TO_CAMERA @ np.diag([1.0, 1.0, -1.0])
    turns = rotvec_to_matrix(turn * rng.standard_normal((count, 3)))
    poses[:, 3:7] = matrix_to_quat(turns @ facing)
    bent = within_limits(hand, rng, count)
    poses[:, 7:] = hand.rest_angles + bend * (bent - hand.rest_angles)
    centre = keypoints(hand, poses)[:, [0, 5, 9, 13, 17]].mean(1)
    poses[:, :3] = np.array([0.0, 0.0, distance]) - centre
    poses[:, :3] += rng.uniform(-0.02, 0.02, (count, 3))
    return poses


def hand_centre(hand: ShapedHand, poses: Float) -> Float:
    """Where a tracker would lay the crop: the mean of the keypoints [m], shape (n, 3)."""
    return keypoints(hand, poses).mean(-2)


def rounded(values: Float) -> Float:
    """The float64 value of what a float32 array on a device holds."""
    return np.asarray(values, np.float32).astype(np.float64)
