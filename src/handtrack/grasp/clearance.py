"""Ways of the hand that keep clear of object and table, bent up or back where they do not.

An example of a reach (grasp.trajectory) was made for another object and another start. Edited to
new ends it may lead through the object, so it is bent by the least that keeps it clear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.skin_points import SkinPoints
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.synthesis.motion import minimum_jerk
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]

POINTS = 250
"""Points of skin that are looked at."""

MARGIN = 0.005
"""Room that is kept [m], or as much as there is where the motion ends."""

BENDS = np.arange(0.0, 0.17, 0.02)
"""How far a way is bent [m], tried one after the other."""

RAMP = 0.4
"""Share of the time in which a bend grows at the start and goes at the end."""


class Surroundings:
    """An object that stands still, and the table it stands on."""

    def __init__(
        self,
        hand: ShapedHand,
        distances: DistanceField,
        place: ArrayLike,
        *,
        skin: BonePoints | None = None,
    ) -> None:
        """Prepare.

        Args:
            hand: The hand that is to keep clear.
            distances: Signed distances of the object.
            place: Pose of the object in the world, whose table is z = 0, shape (7,).
            skin: `clearance_points` of the hand, for many surroundings; spread when absent.
        """
        self._hand, self._field = hand, distances
        self._place = np.asarray(place, np.float64)
        if self._place.shape != (7,):
            raise InputError(f"place has shape {self._place.shape}; expected (7,)")
        self._skin = skin if skin is not None else clearance_points(hand)

    def room(self, poses: ArrayLike) -> Float:
        """Least distance of the skin from object and table [m], shape (n,), of poses (n, 28)."""
        return self.room_of(self.skin(poses))

    def skin(self, poses: ArrayLike) -> Float:
        """The skin that is looked at [m], world, shape (n, npoint, 3), of poses (n, 28)."""
        return self._skin.place(self._hand, poses)

    def room_of(self, points: Float) -> Float:
        """Least distance of such skin from object and table [m], shape (n,)."""
        local = (points - self._place[:3]) @ quat_to_matrix(self._place[3:])
        return np.minimum(self._field.distance(local), points[..., 2]).min(1)

    def away(self, pose: ArrayLike) -> Float:
        """Level unit direction from the object to the palm, shape (3,)."""
        way = palm_centre(keypoints(self._hand, pose)) - self._place[:3]
        way[2] = 0.0
        length = float(np.linalg.norm(way))
        # Straight above the object any direction is as good: the hand goes up.
        return way / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


def clearance_points(hand: ShapedHand) -> BonePoints:
    """The points of a hand's skin that must keep clear."""
    return SkinPoints.of(hand, POINTS).points


def cleared(poses: ArrayLike, around: Surroundings) -> Float:
    """A way bent by the least that keeps it clear, ends unchanged; the clearest if none does.

    Args:
        poses: Hand poses from the start to where closing begins, shape (n, 28).
        around: What to keep clear of.

    Returns:
        Hand poses, shape (n, 28).
    """
    way = np.asarray(poses, np.float64)
    share = np.linspace(0.0, 1.0, len(way))
    shape = minimum_jerk(share / RAMP) * minimum_jerk((1.0 - share) / RAMP)
    back, up = around.away(way[-1]), np.array([0.0, 0.0, 1.0])
    wanted = np.minimum(MARGIN, around.room(way[[0, -1]]).min())
    best, most, skin = way, -np.inf, around.skin(way)
    for bend in BENDS:
        for direction in (up, 0.7 * (up + back), back):
            tried, moved = way.copy(), bend * shape[:, None] * direction
            tried[:, :3] += moved
            room = float(around.room_of(skin + moved[:, None]).min())
            if room > most:
                best, most = tried, room
            # The ends themselves are no clearer than wanted; skin points lie on a grid of floats.
            if room >= wanted - 1e-6:
                return tried
            if bend == 0.0:
                break
    return best
