"""Inverse kinematics: its Jacobian, and poses found again from their keypoints."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.inverse_kinematics import (
    BonePoints,
    initial_pose,
    point_jacobian,
    solve_poses,
)
from handtrack.hand.kinematics import keypoints
from handtrack.transforms import apply_increment, quat_to_matrix
from oracles.scenes import seen_poses, shaped_hand

STEP = 1e-6
CENTRAL = 1e-8
"""Central differences of lengths below a metre with this step: truncation and rounding together."""


@pytest.mark.parametrize("side", ["right", "left"])
def test_jacobian_equals_central_differences(side: str, rng: np.random.Generator) -> None:
    hand = shaped_hand(side, 2)
    points = BonePoints.of_keypoints(hand)
    poses = seen_poses(hand, rng, 4, bend=1.0)
    placed, jacobian = point_jacobian(hand, points, poses)
    np.testing.assert_allclose(placed, keypoints(hand, poses), atol=1e-12)
    for unknown in range(27):
        step = np.zeros((4, 27))
        step[:, unknown] = STEP
        ahead = keypoints(hand, apply_increment(poses, step))
        behind = keypoints(hand, apply_increment(poses, -step))
        np.testing.assert_allclose(
            jacobian[..., unknown], (ahead - behind) / (2 * STEP), atol=CENTRAL
        )


@pytest.mark.parametrize("side", ["right", "left"])
def test_poses_within_the_limits_are_recovered(side: str, rng: np.random.Generator) -> None:
    hand = shaped_hand(side, 3)
    points = BonePoints.of_keypoints(hand)
    truth = seen_poses(hand, rng, 20, turn=1.5, bend=0.7)
    targets = keypoints(hand, truth)
    start = initial_pose(hand, targets)
    for rest_weight, tolerance in ((1e-5, 2e-3), (1e-8, 5e-6)):
        # What remains is the pull of the rest term, which falls with its weight.
        found = solve_poses(hand, points, targets, start, rest_weight=rest_weight)
        error = np.linalg.norm(keypoints(hand, found) - targets, axis=-1)
        assert error.max() < tolerance
    low, high = hand.limits.T
    assert (found[:, 7:] > low - 0.02).all() and (found[:, 7:] < high + 0.02).all()


def test_initial_pose_lies_on_the_palm(rng: np.random.Generator) -> None:
    hand = shaped_hand("left", 1)
    truth = seen_poses(hand, rng, 10, turn=2.0, bend=0.3)
    start = initial_pose(hand, keypoints(hand, truth))
    # Palm keypoints do not depend on the angles, so the palm's frame comes back exactly.
    np.testing.assert_allclose(start[:, :3], truth[:, :3], atol=1e-9)
    np.testing.assert_allclose(
        quat_to_matrix(start[:, 3:7]), quat_to_matrix(truth[:, 3:7]), atol=1e-9
    )
    np.testing.assert_allclose(start[:, 7:], np.tile(hand.rest_angles, (10, 1)))


def test_unknown_targets_are_left_out(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    points = BonePoints.of_keypoints(hand)
    truth = seen_poses(hand, rng, 3, bend=0.4)
    targets = keypoints(hand, truth)
    start = initial_pose(hand, targets)
    targets[:, 7] = np.nan
    targets[0, 12, 1] = np.nan
    found = solve_poses(hand, points, targets, start)
    assert np.isfinite(found).all()
    known = np.isfinite(targets).all(-1)
    error = np.linalg.norm(keypoints(hand, found) - targets, axis=-1)[known]
    assert error.max() < 1e-3


def test_targets_beyond_a_limit_stop_near_it(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    points = BonePoints.of_keypoints(hand)
    truth = seen_poses(hand, rng, 1, bend=0.0)
    pip = 14
    truth[:, pip] = hand.limits[pip - 7, 0] - 0.6
    start = seen_poses(hand, rng, 1, bend=0.0)
    found = solve_poses(hand, points, keypoints(hand, truth), start, limit_weight=1.0)
    assert found[0, pip] > hand.limits[pip - 7, 0] - 0.02


def test_one_frame_does_not_depend_on_the_others(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    points = BonePoints.of_keypoints(hand)
    targets = keypoints(hand, seen_poses(hand, rng, 4))
    start = initial_pose(hand, targets)
    together = solve_poses(hand, points, targets, start, iterations=20)
    alone = solve_poses(hand, points, targets[2:3], start[2:3], iterations=20)
    np.testing.assert_allclose(together[2], alone[0], atol=1e-9)


def test_targets_of_another_shape_are_told() -> None:
    hand = shaped_hand()
    points = BonePoints.of_keypoints(hand)
    with pytest.raises(InputError, match=r"\(2, 20, 3\).*\(2, 21, 3\)"):
        solve_poses(hand, points, np.zeros((2, 20, 3)), np.zeros((2, 28)))
