"""Fingers bent until their joints lie where the forest wants them (II.4.2)."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.forest.rows import IK_DAMPING, IK_STEPS
from handtrack.kernels.finger_ik import bend_fingers, place_fingers
from oracles.device_arrays import download, poisoned, upload
from oracles.forest import finger_joints
from oracles.scenes import rounded, within_limits

Float = NDArray[np.float64]

TOLERANCE = 1e-6
"""A chain of four rotations in float32 [m]."""

REACHED = 1e-4
"""Joints of a target that a finger can reach are this close after many steps [m]."""

NEARLY_REACHED = 3e-3
"""The same after the cascade's few steps, in most cases [m]."""


def chain(posed) -> tuple[wp.array, ...]:
    model = posed.model
    return (
        model.bone_rotations, model.bone_origins, model.tip_offsets, model.angle_axes,
        model.bone_angles,
    )  # fmt: skip


def place(posed, device: str, poses: Float, rows: NDArray | None = None) -> Float:
    hands = np.array(posed.row_hand) if rows is None else rows
    points = poisoned((len(poses), 5, 3), device, wp.vec3)
    place_fingers(*chain(posed), upload(hands, device), upload(poses, device), points=points)
    return download(points)


def bend(
    posed, device: str, starts: Float, targets: Float, *, rows: NDArray | None = None,
    iterations: int = 40,
) -> Float:  # fmt: skip
    hands = np.array(posed.row_hand) if rows is None else rows
    pose = upload(starts, device)
    bend_fingers(
        *chain(posed), posed.model.limits, upload(hands, device), upload(targets, device, wp.vec3),
        iterations=iterations, damping=IK_DAMPING, pose=pose,
    )  # fmt: skip
    return download(pose)


def rest_poses(posed) -> Float:
    """The rows' poses with their fingers at rest."""
    poses = posed.poses.copy()
    poses[:, 7:] = [posed.hand(row).rest_angles for row in range(posed.nrow)]
    return rounded(poses)


@pytest.mark.parametrize("side", ["right", "left"])
def test_joints_are_the_keypoints_in_the_roots_frames(make_posed, device, side) -> None:
    posed = make_posed(device, side=side, seed=91)
    found = place(posed, device, posed.poses)
    for row in range(posed.nrow):
        expected = finger_joints(posed.hand(row), posed.poses[row])
        np.testing.assert_allclose(found[row], expected, atol=TOLERANCE)


@pytest.mark.parametrize("side", ["right", "left"])
def test_fingers_reach_what_they_can_reach(make_posed, device, side, rng) -> None:
    posed = make_posed(device, side=side, seed=92, row_hand=tuple(rng.integers(0, 2, 40)))
    hand = posed.hands[0]
    wanted = posed.poses.copy()
    wanted[:, 7:] = within_limits(hand, rng, posed.nrow)
    targets = np.stack([finger_joints(posed.hand(r), wanted[r]) for r in range(posed.nrow)])
    found = bend(posed, device, rest_poses(posed), targets)
    gaps = np.linalg.norm(place(posed, device, found) - targets, axis=-1)
    assert gaps.max() < REACHED
    quick = bend(posed, device, rest_poses(posed), targets, iterations=IK_STEPS)
    gaps = np.linalg.norm(place(posed, device, quick) - targets, axis=-1)
    assert np.quantile(gaps, 0.9) < NEARLY_REACHED


def test_bending_writes_angles_only(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=93)
    starts = rest_poses(posed)
    found = bend(posed, device, starts, rng.normal(0.0, 0.05, (posed.nrow, 5, 3, 3)))
    np.testing.assert_array_equal(found[:, :7], starts[:, :7])
    assert (found[:, 7:] != starts[:, 7:]).mean() > 0.9


@pytest.mark.parametrize("size", [0.03, 0.3, 30.0])
def test_limits_are_kept_whatever_is_wanted(make_posed, device, rng, size) -> None:
    posed = make_posed(device, seed=94, row_hand=(0, 1) * 10)
    found = bend(posed, device, rest_poses(posed), rng.normal(0.0, size, (posed.nrow, 5, 3, 3)))
    low, high = np.float32(posed.hands[0].limits.T)
    assert ((found[:, 7:] >= low) & (found[:, 7:] <= high)).all()


def test_joints_that_lie_right_stay(make_posed, device) -> None:
    posed = make_posed(device, seed=95)
    targets = np.stack([finger_joints(posed.hand(r), posed.poses[r]) for r in range(posed.nrow)])
    found = bend(posed, device, posed.poses, targets)
    np.testing.assert_allclose(found, posed.poses, atol=1e-4)


def test_a_small_wish_is_followed_by_least_squares(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=96, bend=0.4)
    here = np.stack([finger_joints(posed.hand(r), posed.poses[r]) for r in range(posed.nrow)])
    targets = rounded(here + rng.normal(0.0, 0.004, here.shape))
    found = bend(posed, device, posed.poses, targets)

    def cost(poses: Float) -> Float:
        joints = np.stack([finger_joints(posed.hand(r), poses[r]) for r in range(posed.nrow)])
        return ((joints - targets) ** 2).sum((2, 3))

    least = cost(found)
    assert (least < cost(posed.poses)).all()
    low, high = posed.hands[0].limits.T
    inside = (found[:, 7:] > low + 1e-3) & (found[:, 7:] < high - 1e-3)
    for angle in range(21):
        for step in (-0.02, 0.02):
            moved = found.copy()
            moved[:, 7 + angle] += step
            # Nothing near is better, but for float32.
            better = (least - cost(moved)).max(axis=1)
            assert (better[inside[:, angle]] < 1e-8).all()


def test_targets_that_are_not_numbers_leave_angles_within_limits(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=97)
    targets = np.stack([finger_joints(posed.hand(r), posed.poses[r]) for r in range(posed.nrow)])
    clean = bend(posed, device, rest_poses(posed), targets)
    targets[1, 2] = np.nan
    targets[1, 3, 1] = np.inf
    found = bend(posed, device, rest_poses(posed), targets)
    low, high = np.float32(posed.hands[0].limits.T)
    assert ((found[:, 7:] >= low) & (found[:, 7:] <= high)).all()
    others = np.ones(28, bool)
    others[16:24] = False
    np.testing.assert_array_equal(found[1, others], clean[1, others])
    np.testing.assert_array_equal(found[[0, 2]], clean[[0, 2]])


def test_fingers_of_a_row_do_not_depend_on_the_others(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=98, row_hand=(0, 1, 1, 0, 1, 0, 1))
    targets = rounded(rng.normal(0.0, 0.05, (7, 5, 3, 3)))
    starts = rest_poses(posed)
    together, points = bend(posed, device, starts, targets), place(posed, device, starts)
    for row in (0, 6):
        one = slice(row, row + 1)
        rows = np.array(posed.row_hand)[one]
        alone = bend(posed, device, starts[one], targets[one], rows=rows)
        np.testing.assert_array_equal(alone[0], together[row])
        np.testing.assert_array_equal(place(posed, device, starts[one], rows)[0], points[row])
