"""Votes of the trees, their modes, the palms laid on them, and medians (II.4.2, II.4.3)."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.forest.artifact import FINGER_KEYPOINTS, PALM_KEYPOINTS
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.kernels.forest_votes import (
    MAX_TREES,
    aim_fingers,
    cast_votes,
    join_points,
    lay_palms,
    median_votes,
    pick_modes,
)
from handtrack.transforms import quat_to_matrix, rotvec_to_matrix
from oracles.device_arrays import download, poisoned, upload
from oracles.forest import finger_joints, greedy_modes, laid_palm, root_frames
from oracles.scenes import rounded

Float = NDArray[np.float64]

RADIUS = 0.03
"""Votes closer than this belong together [m]."""

TOLERANCE = 1e-6
"""Some roundings of float32 at half a metre [m]."""

FIT_TOLERANCE = 2e-5
"""A rotation from a singular value decomposition in float32, with lever arms of a few cm."""


def palm_points(posed) -> Float:
    """Palm points of each hand in the palm's frame [m], shape (nhand, 6, 3)."""
    rest = np.zeros(28)
    rest[3] = 1.0
    points = [keypoints(hand, rest)[list(PALM_KEYPOINTS)] for hand in posed.hands]
    return rounded(np.stack(points))


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("holistic", [False, True])
def test_joined_points_are_the_keypoints_in_the_palms_frame(
    make_posed, device, side, holistic
) -> None:
    posed = make_posed(device, side=side, seed=81)
    joints = np.stack([finger_joints(posed.hand(r), posed.poses[r]) for r in range(posed.nrow)])
    points = poisoned((posed.nrow, 6 + 15 * holistic), device, wp.vec3)
    join_points(
        posed.model.bone_rotations, posed.model.bone_origins,
        upload(palm_points(posed), device, wp.vec3), posed.rows, upload(joints, device, wp.vec3),
        points=points,
    )  # fmt: skip
    order = [*PALM_KEYPOINTS, *(FINGER_KEYPOINTS if holistic else ())]
    for row in range(posed.nrow):
        rotation, origin = posed.palm(row)
        expected = (keypoints(posed.hand(row), posed.poses[row])[order] - origin) @ rotation
        np.testing.assert_allclose(download(points)[row], expected, atol=TOLERANCE)


class Ballot:
    """Rows of random leaves with several modes each, in groups."""

    def __init__(self, rng: np.random.Generator, *, groups: int, per_group: int = 3) -> None:
        self.groups, nrow, ntree, nleaf, nmode = groups, groups * per_group, 4, 9, 2
        self.updates = rounded(rng.normal(0.0, 0.02, (nleaf, nmode, 6, 3)))
        self.shares = rounded(rng.dirichlet(np.ones(nmode), nleaf))
        self.group = np.arange(nrow) // per_group
        self.slot = np.arange(nrow) % per_group
        self.points = rounded(rng.normal(0.0, 0.05, (nrow, 6, 3)))
        self.frames = rounded(rotvec_to_matrix(rng.standard_normal((nrow, 1, 3))))
        self.places = rounded(rng.normal(0.0, 0.1, (nrow, 1, 3)))
        self.leaves = rng.integers(0, nleaf, (nrow, ntree))
        self.tree_weights = rounded(rng.integers(0, 3, (nrow, ntree)) / 2)

    def cast(self, device: str, rows: slice = slice(None)) -> tuple[Float, Float]:
        groups = len(np.unique(self.group[rows]))
        count = len(self.group[rows]) // groups * self.leaves.shape[1] * self.updates.shape[1]
        votes = poisoned((groups, count, 6), device, wp.vec3)
        weights = poisoned((groups, count), device)
        cast_votes(
            upload(self.updates, device, wp.vec3), upload(self.shares, device),
            upload(self.group[rows] - self.group[rows].min(), device),
            upload(self.slot[rows], device), upload(self.points[rows], device, wp.vec3),
            upload(self.frames[rows], device, wp.mat33), upload(self.places[rows], device, wp.vec3),
            upload(self.leaves[rows], device), upload(self.tree_weights[rows], device),
            votes=votes, weights=weights,
        )  # fmt: skip
        return download(votes), download(weights)


def test_votes_move_the_points_in_the_palms_frame(device, rng) -> None:
    ballot = Ballot(rng, groups=3)
    votes, weights = ballot.cast(device)
    for group in range(3):
        expected, heights = [], []
        for row in np.flatnonzero(ballot.group == group):
            for tree, leaf in enumerate(ballot.leaves[row]):
                for update, share in zip(ballot.updates[leaf], ballot.shares[leaf], strict=True):
                    local = ballot.points[row] + update
                    expected.append(local @ ballot.frames[row, 0].T + ballot.places[row, 0])
                    heights.append(ballot.tree_weights[row, tree] * share)
        np.testing.assert_allclose(votes[group], expected, atol=TOLERANCE)
        np.testing.assert_allclose(weights[group], heights, rtol=1e-6)


def test_votes_of_a_group_do_not_depend_on_the_others(device, rng) -> None:
    ballot = Ballot(rng, groups=7)
    votes, weights = ballot.cast(device)
    for group in (0, 6):
        alone = ballot.cast(device, slice(3 * group, 3 * group + 3))
        np.testing.assert_array_equal(alone[0][0], votes[group])
        np.testing.assert_array_equal(alone[1][0], weights[group])


def clusters(
    rng: np.random.Generator, groups: int, sizes: tuple[int, ...], *, spread: float = 0.006
) -> tuple[Float, Float]:
    """Votes around centres 0.2 m apart from each other, in any order, and weights below 1."""
    votes = []
    for _ in range(groups):
        centres = rng.normal(0.0, 0.03, (len(sizes), 6, 3)) + 0.2 * np.arange(len(sizes)).reshape(
            -1, 1, 1
        )
        around = np.repeat(centres, sizes, axis=0)
        votes.append(rng.permutation(around + rng.normal(0.0, spread, around.shape)))
    shape = (groups, sum(sizes))
    return rounded(np.stack(votes)), rounded(rng.uniform(0.2, 1.0, shape))


def pick(device: str, votes: Float, weights: Float, count: int) -> tuple[Float, Float]:
    groups, nvote, npoint = votes.shape[:3]
    modes = poisoned((groups, count, npoint), device, wp.vec3)
    heights = poisoned((groups, count), device)
    pick_modes(
        upload(votes, device, wp.vec3), upload(weights, device), radius=RADIUS,
        densities=poisoned((groups, nvote), device), modes=modes, mode_weights=heights,
    )  # fmt: skip
    return download(modes), download(heights)


@pytest.mark.parametrize("spread", [0.004, 0.012, 0.03])
def test_modes_equal_brute_force(device, rng, spread) -> None:
    votes, weights = clusters(rng, 4, (12, 7, 20, 1), spread=spread)
    weights[rng.random(weights.shape) < 0.2] = 0.0
    modes, heights = pick(device, votes, weights, 6)
    for group in range(4):
        expected, densities = greedy_modes(votes[group], weights[group], RADIUS, 6)
        number = len(expected)
        assert number >= 3
        np.testing.assert_allclose(modes[group, :number], expected, atol=TOLERANCE)
        np.testing.assert_allclose(heights[group, :number], densities, rtol=1e-5)


def test_the_heaviest_mode_comes_first(device, rng) -> None:
    votes, weights = clusters(rng, 5, (5, 25, 12))
    _, heights = pick(device, votes, weights, 8)
    assert (np.diff(heights, axis=1) <= 0).all()


def test_clusters_far_apart_are_all_kept_and_the_rest_says_none(device, rng) -> None:
    votes, weights = clusters(rng, 3, (9, 15, 6), spread=0.002)
    modes, heights = pick(device, votes, weights, 5)
    assert (heights[:, :3] > 0).all()
    np.testing.assert_array_equal(heights[:, 3:], 0.0)
    # Rows without a mode of their own hold the first one.
    np.testing.assert_array_equal(modes[:, 3:], np.repeat(modes[:, :1], 2, axis=1))
    middles = np.sort(modes[:, :3].mean((2, 3)), axis=1)
    np.testing.assert_allclose(middles, np.tile([0.0, 0.2, 0.4], (3, 1)), atol=0.03)


def test_a_group_without_votes_has_no_mode_and_spares_the_others(device, rng) -> None:
    votes, weights = clusters(rng, 3, (9, 15))
    modes, heights = pick(device, votes, weights, 3)
    weights[1] = 0.0
    found, found_heights = pick(device, votes, weights, 3)
    np.testing.assert_array_equal(found_heights[1], 0.0)
    assert np.isfinite(found[1]).all()
    np.testing.assert_array_equal(found[[0, 2]], modes[[0, 2]])
    np.testing.assert_array_equal(found_heights[[0, 2]], heights[[0, 2]])


def test_votes_that_are_not_numbers_are_not_heard(device, rng) -> None:
    votes, weights = clusters(rng, 2, (9, 15))
    votes[1, ::4] = np.nan
    modes, heights = pick(device, votes, weights, 3)
    heard = np.arange(24) % 4 > 0
    expected, densities = greedy_modes(votes[1, heard], weights[1, heard], RADIUS, 3)
    number = len(expected)
    np.testing.assert_allclose(modes[1, :number], expected, atol=TOLERANCE)
    np.testing.assert_allclose(heights[1, :number], densities, rtol=1e-5)
    votes[1] = np.nan
    modes, heights = pick(device, votes, weights, 3)
    assert np.isfinite(modes[1]).all()
    np.testing.assert_array_equal(heights[1], 0.0)


def test_modes_of_a_group_do_not_depend_on_the_others(device, rng) -> None:
    votes, weights = clusters(rng, 7, (9, 15))
    modes, heights = pick(device, votes, weights, 3)
    for group in (0, 6):
        one = slice(group, group + 1)
        alone = pick(device, votes[one], weights[one], 3)
        np.testing.assert_array_equal(alone[0][0], modes[group])
        np.testing.assert_array_equal(alone[1][0], heights[group])


def lay(device: str, source: Float, modes: Float, row_hand: NDArray, angles: Float) -> Float:
    nrow = modes.shape[0] * modes.shape[1]
    pose = poisoned((nrow, 28), device)
    lay_palms(
        upload(source, device, wp.vec3), upload(angles, device), upload(row_hand, device),
        upload(modes, device, wp.vec3), pose=pose,
    )  # fmt: skip
    return download(pose)


def voted_palms(
    rng: np.random.Generator, source: Float, row_hand: NDArray, *, noise: float, mirror: float = 1.0
) -> Float:
    """Palm points somewhere in space with noise, and finger points that palms must ignore."""
    turns = rotvec_to_matrix(2.0 * rng.standard_normal((len(row_hand), 3)))
    moved = np.einsum("nij,nkj->nki", turns, source[row_hand] * [1.0, 1.0, mirror])
    moved = moved + rng.normal(0.0, 0.2, (len(row_hand), 1, 3)) + [0.0, 0.0, 0.5]
    moved = moved + rng.normal(0.0, noise, moved.shape)
    return rounded(np.concatenate([moved, rng.standard_normal((len(row_hand), 15, 3))], axis=1))


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_palms_are_laid_by_least_squares(make_posed, device, rng, noise, mirror) -> None:
    source = palm_points(make_posed(device))
    row_hand = rng.integers(0, 2, 30)
    angles = rounded(rng.standard_normal((2, 21)))
    modes = voted_palms(rng, source, row_hand, noise=noise, mirror=mirror)
    poses = lay(device, source, modes.reshape(10, 3, 21, 3), row_hand, angles)
    for row, pose in enumerate(poses):
        rotation, origin = laid_palm(source[row_hand[row]], modes[row, :6])
        np.testing.assert_allclose(quat_to_matrix(pose[3:7]), rotation, atol=FIT_TOLERANCE)
        np.testing.assert_allclose(pose[:3], origin, atol=FIT_TOLERANCE)
        np.testing.assert_array_equal(pose[7:], angles[row_hand[row]])
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:7], axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("kind", ["one place", "zeros", "a line"])
def test_degenerate_votes_still_give_a_pose(make_posed, device, rng, kind) -> None:
    source = palm_points(make_posed(device))
    row_hand = np.array([0, 1, 0])
    modes = voted_palms(rng, source, row_hand, noise=0.0).reshape(1, 3, 21, 3)
    line = np.linspace(0, 0.1, 21)[:, None] * np.array([0.6, 0.0, 0.8])
    modes[0, 1] = {"one place": 0.3, "zeros": 0.0, "a line": line}[kind]
    poses = lay(device, source, modes, row_hand, np.zeros((2, 21)))
    assert np.isfinite(poses).all()
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:7], axis=1), 1.0, atol=1e-5)


def test_a_palm_does_not_depend_on_the_others(make_posed, device, rng) -> None:
    source = palm_points(make_posed(device))
    row_hand = rng.integers(0, 2, 7)
    modes = voted_palms(rng, source, row_hand, noise=0.01)[:, None]
    angles = np.zeros((2, 21))
    together = lay(device, source, modes, row_hand, angles)
    for row in (0, 6):
        one = slice(row, row + 1)
        alone = lay(device, source, modes[one], row_hand[one], angles)
        np.testing.assert_array_equal(alone[0], together[row])


@pytest.mark.parametrize("side", ["right", "left"])
def test_voted_joints_are_aimed_at_in_the_roots_frames(make_posed, device, side) -> None:
    posed = make_posed(device, side=side, seed=82, row_hand=(1, 0, 1, 0))
    frames, places = zip(
        *(root_frames(posed.hand(r), posed.poses[r]) for r in range(4)), strict=True
    )
    order = [*PALM_KEYPOINTS, *FINGER_KEYPOINTS]
    modes = np.stack([keypoints(posed.hand(r), posed.poses[r])[order] for r in range(4)])
    targets = poisoned((4, 5, 3), device, wp.vec3)
    aim_fingers(
        upload(modes.reshape(2, 2, 21, 3), device, wp.vec3),
        upload(np.stack(frames), device, wp.mat33), upload(np.stack(places), device, wp.vec3),
        targets=targets,
    )  # fmt: skip
    for row in range(4):
        expected = finger_joints(posed.hand(row), posed.poses[row])
        np.testing.assert_allclose(download(targets)[row], expected, atol=TOLERANCE)
        # As bone frames say it: the root's own rotation does not move its joint.
        _, origins = bone_frames(posed.hand(row), posed.poses[row])
        np.testing.assert_allclose(np.array(places)[row], origins[[1, 4, 7, 10, 13]], atol=1e-9)


def medians(device: str, updates: Float, leaves: NDArray, weights: Float, points: Float) -> Float:
    trees = leaves.shape[1] // points.shape[1]
    targets = poisoned(points.shape[:3], device, wp.vec3)
    median_votes(
        upload(updates, device, wp.vec3), upload(leaves, device), upload(weights, device),
        upload(points, device, wp.vec3), trees=trees, targets=targets,
    )  # fmt: skip
    return download(targets)


@pytest.mark.parametrize("trees", [1, 2, 5, 10, MAX_TREES])
def test_fingers_move_by_the_median_of_their_trees(device, rng, trees) -> None:
    nrow, npart, nleaf = 7, 5, 200
    updates = rounded(rng.normal(0.0, 0.02, (nleaf, 1, 3, 3)))
    leaves = rng.integers(0, nleaf, (nrow, npart * trees))
    weights = (rng.random((nrow, npart * trees)) < 0.7).astype(float)
    weights[0] = 0.0
    points = rounded(rng.normal(0.0, 0.05, (nrow, npart, 3, 3)))
    targets = medians(device, updates, leaves, weights, points)
    for row, part in np.ndindex(nrow, npart):
        mine = slice(part * trees, (part + 1) * trees)
        heard = updates[leaves[row, mine], 0][weights[row, mine] > 0]
        move = np.median(heard, axis=0) if len(heard) else 0.0
        np.testing.assert_allclose(targets[row, part], points[row, part] + move, atol=TOLERANCE)
    for row in (0, 6):
        one = slice(row, row + 1)
        alone = medians(device, updates, leaves[one], weights[one], points[one])
        np.testing.assert_array_equal(alone[0], targets[row])


def test_without_a_tree_joints_stay_where_they_are(device, rng) -> None:
    updates = rounded(rng.normal(0.0, 0.02, (9, 1, 3, 3)))
    points = rounded(rng.normal(0.0, 0.05, (2, 5, 3, 3)))
    targets = medians(device, updates, np.zeros((2, 15), int), np.zeros((2, 15)), points)
    np.testing.assert_array_equal(targets, points)
