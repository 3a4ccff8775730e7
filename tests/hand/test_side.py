"""A left hand is the mirror image of a right one: points, faces, axes, poses and pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtrack.errors import HandtrackError, InputError
from handtrack.hand.kinematics import keypoints, skin, skin_normals
from handtrack.hand.side import (
    check_side,
    mirror_axes,
    mirror_points,
    mirror_pose,
    mirror_rotations,
)
from handtrack.transforms import matrix_to_quat, quat_to_matrix, rotvec_to_matrix
from oracles.hand_formulas import turn
from oracles.scenes import hand_model, seen_poses, shaped_hand, within_limits

ROUNDING = 1e-12
PICTURE = np.array([-1.0, 1.0, 1.0])
"""A picture mirrored left to right turns the camera's x over."""

seeds = st.integers(0, 2**32 - 1)


def pose_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.zeros(28)
    pose[:3] = rng.uniform(-1, 1, 3)
    pose[3:7] = matrix_to_quat(rotvec_to_matrix(rng.standard_normal(3)))
    pose[7:] = within_limits(shaped_hand(), rng, 1)[0]
    return pose


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=seeds, subject=st.integers(0, 4))
def test_mirrored_pose_gives_mirrored_vertices(seed: int, subject: int) -> None:
    right, left = shaped_hand("right", subject), shaped_hand("left", subject)
    pose = pose_of(seed)
    for points in (keypoints, skin, skin_normals):
        np.testing.assert_allclose(
            points(left, mirror_pose(pose)), points(right, pose) * PICTURE, atol=ROUNDING
        )


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=seeds)
def test_mirroring_twice_is_nothing(seed: int) -> None:
    pose = pose_of(seed)
    back = mirror_pose(mirror_pose(pose))
    np.testing.assert_allclose(np.delete(back, range(3, 7)), np.delete(pose, range(3, 7)))
    np.testing.assert_allclose(quat_to_matrix(back[3:7]), quat_to_matrix(pose[3:7]), atol=ROUNDING)


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=seeds)
def test_joint_angles_keep_their_values(seed: int) -> None:
    pose = pose_of(seed)
    np.testing.assert_array_equal(mirror_pose(pose)[7:], pose[7:])
    rotation = quat_to_matrix(mirror_pose(pose)[3:7])
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=seeds)
def test_turning_about_a_mirrored_axis_is_the_mirrored_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis, angle = rng.standard_normal(3), rng.uniform(-3, 3)
    axis /= np.linalg.norm(axis)
    point = rng.standard_normal(3)
    mirrored = turn(mirror_axes(axis), angle)
    np.testing.assert_allclose(mirrored, mirror_rotations(turn(axis, angle)), atol=ROUNDING)
    np.testing.assert_allclose(
        mirrored @ mirror_points(point), mirror_points(turn(axis, angle) @ point), atol=ROUNDING
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_faces_look_outwards_on_both_sides(side: str, rng: np.random.Generator) -> None:
    hand = shaped_hand(side, 1)
    corners = skin(hand, seen_poses(hand, rng, 1)[0])[hand.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    # Divergence theorem: positive only when the triangles are outward counter-clockwise.
    assert 1e-4 < volume < 1e-3


def test_both_sides_share_what_has_no_side() -> None:
    right, left = shaped_hand("right", 1), shaped_hand("left", 1)
    for name in ("weights", "weight_bones", "limits", "rest_angles", "bone_lengths", "cut_x"):
        np.testing.assert_array_equal(getattr(right, name), getattr(left, name))
    assert (right.side, left.side) == ("right", "left")


@pytest.mark.parametrize("side", ["Right", "", "both", "l"])
def test_an_unknown_side_is_told(side: str) -> None:
    with pytest.raises(InputError, match="'right' or 'left'") as caught:
        check_side(side)
    assert isinstance(caught.value, HandtrackError) and isinstance(caught.value, ValueError)
    with pytest.raises(InputError):
        hand_model().shaped(side=side)
