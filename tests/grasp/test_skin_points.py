"""Points spread over the skin: even, on the skin, and within their groups' balls."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.grasp.skin_points import SkinPoints, spread_points
from handtrack.hand.kinematics import skin
from oracles.scenes import shaped_hand


def rest_pose(angles: np.ndarray) -> np.ndarray:
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, angles
    return pose


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_place_of_the_skin_is_near_a_point(side: str) -> None:
    hand = shaped_hand(side, 1)
    vertices = skin(hand, rest_pose(hand.rest_angles))
    gaps = []
    for count in (100, 400):
        chosen = spread_points(hand, count)
        assert len(set(chosen.tolist())) == count
        away = np.linalg.norm(vertices[:, None] - vertices[chosen][None], axis=2).min(1)
        gaps.append(away.max())
    assert gaps[0] < 0.02
    assert gaps[1] < 0.55 * gaps[0]  # four times the points, half the gaps


def test_groups_hold_all_points_within_their_balls() -> None:
    hand = shaped_hand("right", 1)
    points = SkinPoints.of(hand, 300)
    assert len(points.points.bones) == points.group_starts[-1] == 300
    for k, bone in enumerate(points.group_bones):
        part = slice(points.group_starts[k], points.group_starts[k + 1])
        assert (points.points.bones[part] == bone).all()
        away = np.linalg.norm(points.points.offsets[part] - points.group_centres[k], axis=1)
        assert away.max() <= points.group_radii[k] + 1e-12
    assert points.group_radii.max() < 0.06


def test_points_stay_on_the_skin_of_a_bent_hand(rng: np.random.Generator) -> None:
    hand = shaped_hand("right", 1)
    points = SkinPoints.of(hand, 300)
    low, high = hand.limits.T
    pose = rest_pose(low + 0.7 * (high - low))
    placed = points.points.place(hand, pose)
    away = np.linalg.norm(placed[:, None] - skin(hand, pose)[None], axis=2).min(1)
    assert np.median(away) < 0.001
    assert np.quantile(away, 0.95) < 0.005  # next to joints skin follows both bones
