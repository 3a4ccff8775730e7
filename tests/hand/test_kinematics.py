"""Forward kinematics and skinning in NumPy against the equations taken one matrix at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtrack.hand.kinematics import bone_frames, keypoints, skin, skin_normals
from handtrack.hand.model import vertex_normals
from handtrack.hand.skeleton import BONE_PARENTS, NBONE
from handtrack.transforms import matrix_to_quat, quat_to_matrix, rotvec_to_matrix
from oracles.hand_formulas import Subject
from oracles.scenes import hand_model, seen_poses, shaped_hand, within_limits

ROUNDING = 1e-12
STORED_WEIGHTS = 5e-7
"""The artifact's float32 weights sum to one within 1e-7, so a shift of metres is off by as much."""

seeds = st.integers(0, 2**32 - 1)


def random_pose(seed: int, side: str = "right") -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.zeros(28)
    pose[:3] = rng.uniform(-1, 1, 3)
    pose[3:7] = matrix_to_quat(rotvec_to_matrix(rng.standard_normal(3)))
    pose[7:] = within_limits(shaped_hand(side, 2), rng, 1)[0]
    return pose


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bones_keypoints_and_vertices_follow_the_equations(seed: int) -> None:
    model = hand_model()
    shape = model.sample_shape(np.random.default_rng(seed))
    hand, subject = model.shaped(shape), Subject(model, shape)
    pose = random_pose(seed)
    frames = subject.frames(pose)

    rotations, origins = bone_frames(hand, pose)
    np.testing.assert_allclose(rotations, [f[:3, :3] for f in frames], atol=ROUNDING)
    np.testing.assert_allclose(origins, [f[:3, 3] for f in frames], atol=ROUNDING)
    np.testing.assert_allclose(keypoints(hand, pose), subject.keypoints(pose), atol=ROUNDING)

    some = np.random.default_rng(seed).choice(hand.nvert, 300, replace=False)
    expected = [subject.vertex(int(v), frames) for v in some]
    np.testing.assert_allclose(skin(hand, pose)[some], expected, atol=ROUNDING)


@settings(deadline=None, max_examples=20, derandomize=True)
@given(seed=seeds, side=st.sampled_from(["right", "left"]))
def test_moving_the_palm_moves_everything_rigidly(seed: int, side: str) -> None:
    hand, pose = shaped_hand(side, 2), random_pose(seed, side)
    rng = np.random.default_rng(seed)
    turn, shift = rotvec_to_matrix(rng.standard_normal(3)), rng.uniform(-1, 1, 3)
    moved = pose.copy()
    moved[:3] = turn @ pose[:3] + shift
    moved[3:7] = matrix_to_quat(turn @ quat_to_matrix(pose[3:7]))
    for points in (keypoints, skin):
        expected = points(hand, pose) @ turn.T + shift
        np.testing.assert_allclose(points(hand, moved), expected, atol=STORED_WEIGHTS)
    np.testing.assert_allclose(
        skin_normals(hand, moved), skin_normals(hand, pose) @ turn.T, atol=1e-10
    )


def test_any_batch_shape_gives_the_same_hands(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    poses = seen_poses(hand, rng, 6)
    for function in (keypoints, skin, skin_normals):
        one_by_one = np.stack([function(hand, pose) for pose in poses])
        np.testing.assert_allclose(function(hand, poses), one_by_one, atol=ROUNDING)
        np.testing.assert_allclose(
            function(hand, poses.reshape(2, 3, 28)),
            one_by_one.reshape(2, 3, *one_by_one.shape[1:]),
            atol=ROUNDING,
        )


def test_bones_keep_their_lengths_in_every_pose(rng: np.random.Generator) -> None:
    hand = shaped_hand("right", 4)
    _, origins = bone_frames(hand, seen_poses(hand, rng, 20, bend=1.0))
    for bone in range(1, NBONE):
        length = np.linalg.norm(origins[:, bone] - origins[:, BONE_PARENTS[bone]], axis=1)
        np.testing.assert_allclose(length, np.linalg.norm(hand.bone_origins[bone]), atol=ROUNDING)


def test_the_listed_bone_lengths_are_distances_between_keypoints() -> None:
    hand = shaped_hand("right", 4)
    points = keypoints(hand, random_pose(3))
    lengths = hand.bone_lengths
    assert lengths[0] == pytest.approx(np.linalg.norm(points[9] - points[0]))
    for finger in range(5):
        first = 1 + 4 * finger
        steps = np.linalg.norm(np.diff(points[first : first + 4], axis=0), axis=1)
        np.testing.assert_allclose(lengths[1 + 3 * finger : 4 + 3 * finger], steps, atol=ROUNDING)


@pytest.mark.parametrize("side", ["right", "left"])
def test_blended_normals_are_unit_and_close_to_the_mesh_normals(side: str) -> None:
    hand = shaped_hand(side, 3)
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    normals = skin_normals(hand, pose)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=ROUNDING)
    # In the rest pose they are the mesh's own, by construction.
    np.testing.assert_allclose(normals, vertex_normals(skin(hand, pose), hand.faces), atol=1e-9)
    # Elsewhere blending bends them little: most stay within a few degrees of the posed mesh.
    rng = np.random.default_rng(0)
    pose[7:] += 0.3 * (within_limits(hand, rng, 1)[0] - pose[7:])
    cosine = (skin_normals(hand, pose) * vertex_normals(skin(hand, pose), hand.faces)).sum(1)
    assert np.median(cosine) > np.cos(np.radians(5))
    assert np.mean(cosine > np.cos(np.radians(30))) > 0.97
