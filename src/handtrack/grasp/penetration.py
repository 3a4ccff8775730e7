"""How deep the hand's skin enters an object, whatever solids the simulation gave the hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]

_BATCH = 64
"""Poses skinned at a time: bounds the memory."""


def skin_depths(
    hand: ShapedHand, hand_poses: Float, field: DistanceField, object_poses: Float
) -> Float:
    """Deepest place of the skin in an object [m], 0 where it stays outside, shape (n,).

    Args:
        hand: The hand.
        hand_poses: Its poses in the world, shape (n, 28).
        field: Signed distances of the object, in its frame.
        object_poses: Poses of the object in the world, shape (n, 7).
    """
    depths = np.zeros(len(hand_poses))
    for start in range(0, len(hand_poses), _BATCH):
        part = slice(start, start + _BATCH)
        points = skin(hand, hand_poses[part]) - object_poses[part, None, :3]
        points = points @ quat_to_matrix(object_poses[part, 3:])  # R^T p as row vectors
        distances = field.distance(points.reshape(-1, 3)).reshape(points.shape[:2])
        depths[part] = np.maximum(-distances.min(axis=1), 0.0)
    return depths
