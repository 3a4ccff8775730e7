"""Retargeting: angles of hands with other proportions, and of the recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.retarget import retarget_keypoints
from oracles.scenes import hand_model, seen_poses, shaped_hand


def test_angles_of_another_hand_come_back(rng: np.random.Generator) -> None:
    other = shaped_hand(seed=5)
    # A hand with joints where our shape space would not put them, too.
    tips = other.tip_offsets.copy()
    tips[:, 0] *= [1.1, 0.9, 1.05, 0.95, 1.1]
    other = replace(other, tip_offsets=tips)
    poses = seen_poses(other, rng, 40, bend=0.6)
    found = retarget_keypoints(shaped_hand(), keypoints(other, poses))
    assert 1e3 * found.residual.mean() < 1.5
    fingers = np.abs(np.degrees(found.poses[:, 12:] - poses[:, 12:]))
    assert np.median(fingers) < 4.0 and np.percentile(fingers, 90) < 15.0
    assert np.abs(found.hand.bone_lengths[5:] - other.bone_lengths[5:]).max() < 0.004


def test_results_stay_within_the_limits(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    points = keypoints(hand, seen_poses(hand, rng, 20, bend=1.0))
    points += rng.normal(0, 0.004, points.shape)
    found = retarget_keypoints(hand, points, rounds=2)
    low, high = hand_model().limits.T
    angles = found.poses[:, 7:]
    assert np.degrees(np.maximum(low - angles, angles - high).max()) < 3.0
    assert np.isfinite(found.poses).all()
    np.testing.assert_allclose(np.linalg.norm(found.poses[:, 3:7], axis=1), 1.0, atol=1e-9)


@pytest.mark.data
def test_recorded_motion_is_met_within_a_millimetre(recordings: Path) -> None:
    with np.load(recordings / "recorded_hand_motion.npz", allow_pickle=False) as data:
        recorded = data["keypoints"][::10]
    found = retarget_keypoints(shaped_hand(), recorded, rounds=4)
    assert 1e3 * found.residual.mean() < 1.0
    assert 1e3 * np.percentile(found.residual, 95) < 3.0
