"""Rotations and pose increments: group axioms, inverses and any batch shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handtrack.transforms import (
    apply_increment,
    cross_matrix,
    matrix_to_quat,
    matrix_to_rotvec,
    pose_difference,
    quat_to_matrix,
    rotvec_to_matrix,
)

ROUNDING = 1e-12
"""Float64 rounding of a few products of numbers near one."""

seeds = st.integers(0, 2**32 - 1)
batches = st.sampled_from([(), (1,), (3,), (2, 3), (0,), (2, 0, 4)])


def random_rotvecs(seed: int, batch: tuple[int, ...], most: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((*batch, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return direction * rng.uniform(0.0, most, (*batch, 1))


def random_poses(seed: int, batch: tuple[int, ...]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = rng.uniform(-1.0, 1.0, (*batch, 28))
    pose[..., 3:7] = matrix_to_quat(rotvec_to_matrix(random_rotvecs(seed, batch)))
    return pose


def quat_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = aw * bw - (av * bv).sum(-1, keepdims=True)
    return np.concatenate([real, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=seeds, batch=batches)
def test_rotation_matrices_form_a_group(seed: int, batch: tuple[int, ...]) -> None:
    a, b, c = (rotvec_to_matrix(random_rotvecs(seed ^ k, batch)) for k in (0, 1, 2))
    identity = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    assert a.shape == (*batch, 3, 3)
    np.testing.assert_allclose(a @ np.swapaxes(a, -1, -2), identity, atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.det(a), 1.0, atol=ROUNDING)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=ROUNDING)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=seeds, batch=batches)
def test_quaternions_multiply_as_their_matrices_do(seed: int, batch: tuple[int, ...]) -> None:
    a, b = (rotvec_to_matrix(random_rotvecs(seed ^ k, batch)) for k in (0, 1))
    qa, qb = matrix_to_quat(a), matrix_to_quat(b)
    assert qa.shape == (*batch, 4)
    assert (qa[..., 0] >= 0).all()
    np.testing.assert_allclose(quat_to_matrix(qa), a, atol=ROUNDING)
    np.testing.assert_allclose(quat_to_matrix(quat_product(qa, qb)), a @ b, atol=ROUNDING)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=seeds, batch=batches, angle=st.sampled_from([0.0, 1e-12, 1e-6, 1e-3, 1.0, 3.14]))
def test_logarithm_undoes_the_exponential(seed: int, batch: tuple[int, ...], angle: float) -> None:
    rotvec = random_rotvecs(seed, batch)
    rotvec *= angle / np.maximum(np.linalg.norm(rotvec, axis=-1, keepdims=True), 1e-9)
    back = matrix_to_rotvec(rotvec_to_matrix(rotvec))
    # Near half a turn the logarithm magnifies rounding.
    np.testing.assert_allclose(back, rotvec, atol=1e-10)


@pytest.mark.parametrize("quat", [[2.0, 0, 0, 0], [0, -3.0, 0, 0], [1e-3, 1e-3, 0, 0]])
def test_a_quaternion_need_not_be_normalised(quat: list[float]) -> None:
    expected = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    np.testing.assert_allclose(quat_to_matrix(quat), expected, atol=ROUNDING)


def test_quaternion_is_w_first_and_turns_counter_clockwise() -> None:
    half = np.sqrt(0.5)
    # A quarter turn about z takes x to y.
    np.testing.assert_allclose(
        quat_to_matrix([half, 0, 0, half]) @ [1, 0, 0], [0, 1, 0], atol=ROUNDING
    )


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=seeds, batch=batches)
def test_no_increment_leaves_the_pose(seed: int, batch: tuple[int, ...]) -> None:
    pose = random_poses(seed, batch)
    moved = apply_increment(pose, np.zeros((*batch, 27)))
    assert moved.shape == (*batch, 28)
    np.testing.assert_allclose(moved, pose, atol=ROUNDING)


@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=seeds, batch=batches)
def test_difference_and_increment_are_inverse(seed: int, batch: tuple[int, ...]) -> None:
    start, goal = random_poses(seed, batch), random_poses(seed ^ 1, batch)
    step = pose_difference(goal, start)
    assert step.shape == (*batch, 27)
    reached = apply_increment(start, step)
    np.testing.assert_allclose(
        quat_to_matrix(reached[..., 3:7]), quat_to_matrix(goal[..., 3:7]), atol=1e-10
    )
    np.testing.assert_allclose(
        np.delete(reached, range(3, 7), -1), np.delete(goal, range(3, 7), -1), atol=ROUNDING
    )

    short = 0.3 * np.random.default_rng(seed).standard_normal((*batch, 27)) / 2
    np.testing.assert_allclose(
        pose_difference(apply_increment(start, short), start), short, atol=1e-10
    )


def test_rotation_increment_is_in_the_palm_frame() -> None:
    start = random_poses(5, ())
    step = np.zeros(27)
    step[3:6] = [0.1, -0.2, 0.3]
    moved = apply_increment(start, step)
    expected = quat_to_matrix(start[3:7]) @ rotvec_to_matrix(step[3:6])
    np.testing.assert_allclose(quat_to_matrix(moved[3:7]), expected, atol=ROUNDING)
    np.testing.assert_array_equal(moved[:3], start[:3])


def test_one_pose_takes_many_increments() -> None:
    pose, steps = random_poses(1, ()), np.zeros((4, 27))
    steps[:, 0], steps[:, 4] = [0.0, 1.0, 2.0, 3.0], [0.0, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(
        apply_increment(pose, steps), [apply_increment(pose, step) for step in steps]
    )


def test_rows_times_a_cross_matrix_are_cross_products() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.standard_normal((2, 4, 5, 3))
    found = (b[..., None, :] @ cross_matrix(a))[..., 0, :]
    np.testing.assert_allclose(found, np.cross(a, b), atol=ROUNDING)
