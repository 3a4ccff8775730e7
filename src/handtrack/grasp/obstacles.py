"""Other things that stand about where an object is taken and where it is set down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.mirror import mirrored_field, mirrored_object_poses
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """A thing that stands still."""

    distances: DistanceField
    """Its signed distances."""
    place: Float
    """Its pose in the world: centre [m] and quaternion, shape (7,)."""

    def __post_init__(self) -> None:
        """Check the pose.

        Raises:
            InputError: It is none.
        """
        if np.shape(self.place) != (7,) or not np.isfinite(self.place).all():
            raise InputError(
                f"an obstacle's place has shape {np.shape(self.place)}; expected 3 metres and a "
                "quaternion"
            )

    def mirrored(self) -> Obstacle:
        """Its mirror image (`grasp.mirror`)."""
        return Obstacle(
            distances=mirrored_field(self.distances), place=mirrored_object_poses(self.place)
        )


def room_beside(
    hand: ShapedHand, skin: BonePoints, poses: ArrayLike, obstacles: Sequence[Obstacle]
) -> Float:
    """Least distance of the skin from obstacles [m], negative inside, inf without any, shape (n,).

    Args:
        hand: The hand.
        skin: Points of its skin.
        poses: Hand poses in the world, shape (n, 28).
        obstacles: What is in the way.
    """
    points = skin.place(hand, poses)
    room = np.full(len(points), np.inf)
    for obstacle in obstacles:
        local = (points - obstacle.place[:3]) @ quat_to_matrix(obstacle.place[3:])
        room = np.minimum(room, obstacle.distances.distance(local).min(1))
    return room
