"""Points spread over a hand's skin, in groups with a ball around each, for telling collisions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE, NQ

Float = NDArray[np.float64]

PALM_GROUPS = 12
"""Groups of the palm's points, which would not fit a small ball."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SkinPoints:
    """Points that each move with one bone, sorted into groups within a ball."""

    points: BonePoints
    """The points, group by group."""
    group_bones: NDArray[np.int64]
    """Bone of each group, shape (ngroup,)."""
    group_starts: NDArray[np.int64]
    """First point of each group, and the end of the last, shape (ngroup + 1,)."""
    group_centres: Float
    """Centres of balls around the groups [m], bone frames, shape (ngroup, 3)."""
    group_radii: Float
    """Their radii [m], shape (ngroup,)."""

    @classmethod
    def of(cls, hand: ShapedHand, count: int) -> SkinPoints:
        """Spread so many points, each moved by the bone that moves the skin there most."""
        spread = BonePoints.of_skin(hand, spread_points(hand, count))
        groups: list[tuple[int, Float]] = []
        for bone in range(NBONE):
            own = spread.offsets[spread.bones == bone]
            parts = min(PALM_GROUPS if bone == 0 else 1, len(own))
            # The points came far from each other first: the first ones are the parts' middles.
            label = np.linalg.norm(own[:, None] - own[None, :parts], axis=2).argmin(1)
            groups += [(bone, own[label == part]) for part in range(parts)]
        sizes = [len(places) for _, places in groups]
        centres = np.array([0.5 * (places.min(0) + places.max(0)) for _, places in groups])
        return cls(
            points=BonePoints(
                bones=np.repeat([bone for bone, _ in groups], sizes),
                offsets=np.concatenate([places for _, places in groups]),
            ),
            group_bones=np.array([bone for bone, _ in groups]),
            group_starts=np.concatenate([[0], np.cumsum(sizes)]),
            group_centres=centres,
            group_radii=np.array([
                np.linalg.norm(places - centre, axis=1).max()
                for (_, places), centre in zip(groups, centres, strict=True)
            ]),
        )  # fmt: skip


def spread_points(hand: ShapedHand, count: int) -> NDArray[np.intp]:
    """Numbers of so many vertices spread evenly over the skin, each far from those before it."""
    pose = np.zeros(NQ)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    points = np.ascontiguousarray(skin(hand, pose).T)
    chosen = np.zeros(min(count, points.shape[1]), np.intp)
    nearest = np.full(points.shape[1], np.inf)
    for k in range(1, len(chosen)):
        x, y, z = points - points[:, chosen[k - 1], None]
        np.minimum(nearest, x * x + y * y + z * z, out=nearest)
        chosen[k] = nearest.argmax()
    return chosen
