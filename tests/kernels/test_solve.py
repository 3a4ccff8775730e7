"""Normal equations, the damped solve, accept or reject, and the pose update (Eq. II.27)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtrack.hand import skeleton
from handtrack.hand.skeleton import finger_of_bone
from handtrack.kernels import solve
from handtrack.kernels.residuals import NLOCAL, vec11
from handtrack.kernels.solve import mat11
from handtrack.transforms import (
    apply_increment,
    matrix_to_quat,
    quat_to_matrix,
    rotvec_to_matrix,
)
from oracles.device_arrays import download, poisoned, upload
from oracles.energy import NV, dense_rows
from oracles.scenes import rounded

Float = NDArray[np.float64]

NO_LIMITS = {"max_translation": 1e6, "max_rotation": 1e6, "max_angle": 1e6}


def compact_rows(rng: np.random.Generator, nrow: int, nslot: int) -> tuple[Float, Float, NDArray]:
    """Random Jacobian rows; a finger's eleventh number is empty, dead slots hold garbage."""
    rows = rng.standard_normal((nrow, nslot, 11))
    chains = rng.integers(-2, 5, (nrow, nslot))
    rows[chains > 0, 10] = 0.0
    values = rng.standard_normal((nrow, nslot))
    rows[chains < 0] = np.nan
    values[chains < 0] = np.nan
    return rounded(rows), rounded(values), chains


def accumulate(device: str, rows: Float, values: Float, chains: NDArray) -> tuple[Float, Float]:
    nrow = len(rows)
    hessian, gradient = poisoned((nrow, NV, NV), device), poisoned((nrow, NV), device)
    solve.accumulate_normal_equations(
        upload(rows, device, vec11), upload(values, device), upload(chains, device),
        chain_hessians=poisoned((nrow, 5), device, mat11),
        chain_gradients=poisoned((nrow, 5), device, vec11),
        hessian=hessian, gradient=gradient,
    )  # fmt: skip
    return download(hessian), download(gradient)


@pytest.mark.parametrize("nslot", [1, 63, 64, 1000])
def test_normal_equations_equal_the_dense_product(device: str, nslot: int, rng) -> None:
    rows, values, chains = compact_rows(rng, 3, nslot)
    hessian, gradient = accumulate(device, rows, values, chains)
    for row in range(3):
        live = chains[row] >= 0
        dense = dense_rows(rows[row, live], chains[row, live])
        size = 1 + live.sum()
        np.testing.assert_allclose(hessian[row], dense.T @ dense, atol=1e-6 * size)
        np.testing.assert_allclose(gradient[row], dense.T @ values[row, live], atol=1e-6 * size)
        np.testing.assert_array_equal(hessian[row], hessian[row].T)


def test_no_residual_gives_an_empty_system(device: str) -> None:
    rows = np.full((2, 30, 11), np.nan)
    hessian, gradient = accumulate(device, rows, rows[..., 0], np.full((2, 30), -2))
    np.testing.assert_array_equal(hessian, 0.0)
    np.testing.assert_array_equal(gradient, 0.0)


def test_different_fingers_are_coupled_through_the_palm_only(device: str, rng) -> None:
    hessian, _ = accumulate(device, *compact_rows(rng, 1, 400))
    finger = np.array([-1] * 6 + [0] * 5 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4)
    apart = (finger[:, None] != finger) & (finger[:, None] >= 0) & (finger >= 0)
    np.testing.assert_array_equal(hessian[0][apart], 0.0)
    assert (hessian[0][~apart] != 0).all()


@pytest.mark.parametrize("count", [1, 64, 65, 3000])
def test_costs_are_summed_per_row(device: str, count: int, rng) -> None:
    costs = rounded(rng.random((3, count)))
    totals = poisoned(3, device)
    solve.sum_costs(upload(costs, device), totals=totals)
    np.testing.assert_allclose(download(totals), costs.sum(1), rtol=1e-5)


def systems(rng: np.random.Generator, nrow: int) -> tuple[Float, Float, Float, Float]:
    """Positive definite systems, gradients, damping and diagonal floors."""
    factor = rng.standard_normal((nrow, 60, NV)) * rng.uniform(0.3, 3.0, NV)
    hessian = np.swapaxes(factor, 1, 2) @ factor
    gradient = rng.standard_normal((nrow, NV)) * 5
    return tuple(map(rounded, (hessian, gradient, rng.uniform(0, 1, nrow), rng.uniform(0, 1, NV))))


def poses_of(rng: np.random.Generator, nrow: int) -> Float:
    poses = rng.uniform(-1, 1, (nrow, 28))
    poses[:, 3:7] = matrix_to_quat(rotvec_to_matrix(rng.standard_normal((nrow, 3))))
    return rounded(poses)


def run_solve(
    device: str,
    hessian: Float,
    gradient: Float,
    damping: Float,
    floors: Float,
    start: Float,
    **limits: float,
) -> tuple[Float, Float]:
    """Newton step before shortening, and moved poses."""
    nrow = len(start)
    step, pose = poisoned((nrow, NV), device), poisoned((nrow, 28), device)
    solve.solve_step(
        upload(hessian, device), upload(gradient, device), upload(damping, device),
        upload(floors, device), upload(start, device), **{**NO_LIMITS, **limits},
        system=poisoned((nrow, NV, NV), device), step=step, pose=pose,
    )  # fmt: skip
    return download(step), download(pose)


def damped_step(hessian: Float, gradient: Float, damping: float, floors: Float) -> Float:
    damped = hessian + np.diag(damping * np.diag(hessian) + floors)
    return np.linalg.solve(damped, gradient)


def assert_same_pose(found: Float, expected: Float, atol: float) -> None:
    """Compare poses; a quaternion and its negative are the same rotation."""
    np.testing.assert_allclose(quat_to_matrix(found[3:7]), quat_to_matrix(expected[3:7]), atol=atol)
    np.testing.assert_allclose(
        np.delete(found, range(3, 7)), np.delete(expected, range(3, 7)), atol=atol
    )
    assert np.linalg.norm(found[3:7]) == pytest.approx(1.0, abs=1e-6)


def test_step_and_pose_equal_a_dense_float64_solve(device: str, rng) -> None:
    nrow = 5
    hessian, gradient, damping, floors = systems(rng, nrow)
    start = poses_of(rng, nrow)
    step, pose = run_solve(device, hessian, gradient, damping, floors, start)
    for row in range(nrow):
        expected = damped_step(hessian[row], gradient[row], damping[row], floors)
        np.testing.assert_allclose(step[row], expected, atol=2e-5 * np.abs(expected).max())
        assert_same_pose(pose[row], apply_increment(start[row], -expected), 5e-5)


def test_damping_shortens_the_step(device: str, rng) -> None:
    hessian, gradient, _, floors = systems(rng, 1)
    hessian, gradient = np.tile(hessian, (6, 1, 1)), np.tile(gradient, (6, 1))
    damping = np.array([0.0, 0.01, 0.1, 1.0, 10.0, 1000.0])
    step, _ = run_solve(device, hessian, gradient, damping, floors, poses_of(rng, 6))
    assert (np.diff(np.linalg.norm(step, axis=1)) < 0).all()


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-4, 1e-2, 1.0, 3.0])
def test_rotation_update_is_the_exponential(device: str, size: float, rng) -> None:
    # A unit system makes the step the gradient, so any turn can be asked for.
    nrow = 8
    direction = rng.standard_normal((nrow, 3))
    turns = size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    gradient = np.zeros((nrow, NV))
    gradient[:, 3:6] = -turns
    hessian = np.tile(np.eye(NV), (nrow, 1, 1))
    start = poses_of(rng, nrow)
    _, pose = run_solve(device, hessian, gradient, np.zeros(nrow), np.zeros(NV), start)
    for row in range(nrow):
        expected = quat_to_matrix(start[row, 3:7]) @ rotvec_to_matrix(turns[row])
        np.testing.assert_allclose(quat_to_matrix(pose[row, 3:7]), expected, atol=1e-6)
    np.testing.assert_allclose(np.delete(pose, range(3, 7), 1), np.delete(start, range(3, 7), 1))


def test_a_long_step_is_shortened_as_a_whole(device: str, rng) -> None:
    limits = {"max_translation": 0.05, "max_rotation": 0.4, "max_angle": 0.5}
    bound = np.repeat([0.05, 0.4, 0.5], [3, 3, 21])
    nrow = 30
    hessian = np.tile(np.eye(NV), (nrow, 1, 1))
    gradient = rounded(rng.standard_normal((nrow, NV)) * 10 ** rng.uniform(-3, 4, (nrow, 1)))
    start = poses_of(rng, nrow)
    step, pose = run_solve(device, hessian, gradient, np.zeros(nrow), np.zeros(NV), start, **limits)
    shortened = 0
    for row in range(nrow):
        factor = min(1.0, (bound / np.abs(gradient[row])).min())
        shortened += factor < 1
        assert_same_pose(pose[row], apply_increment(start[row], -factor * gradient[row]), 1e-5)
    assert 5 < shortened < nrow
    # What is stored is the Newton step itself.
    np.testing.assert_allclose(step, gradient, rtol=1e-5)


def broken_systems() -> dict[str, tuple[Float, Float]]:
    hessian, gradient = np.eye(NV), np.ones(NV)
    broken = {"empty": (np.zeros((NV, NV)), gradient)}
    for name, value in (("nan", np.nan), ("infinite", np.inf), ("negative", -5.0)):
        bad = hessian.copy()
        bad[13, 13] = value
        broken[f"{name} hessian"] = (bad, gradient)
    for name, value in (("nan", np.nan), ("infinite", np.inf)):
        worse = gradient.copy()
        worse[26] = value
        broken[f"{name} gradient"] = (hessian, worse)
    last = hessian.copy()
    last[26, 26] = 0.0
    broken["singular"] = (last, gradient)
    return broken


@pytest.mark.parametrize("kind", broken_systems())
def test_an_unsolvable_system_leaves_the_pose(device: str, kind: str, rng) -> None:
    bad_hessian, bad_gradient = broken_systems()[kind]
    start = poses_of(rng, 3)
    hessian = np.stack([np.eye(NV), bad_hessian, np.eye(NV)])
    gradient = np.stack([np.ones(NV), bad_gradient, np.ones(NV)])
    _, pose = run_solve(device, hessian, gradient, np.zeros(3), np.zeros(NV), start)
    np.testing.assert_allclose(pose[1], start[1], atol=1e-6)
    for row in (0, 2):
        assert_same_pose(pose[row], apply_increment(start[row], -np.ones(NV)), 1e-5)


@settings(
    deadline=None,
    max_examples=40,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    scale=st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e6, 1e20, np.inf, np.nan]),
    slope=st.sampled_from([0.0, 1e-30, 1.0, 1e10, 1e38, np.inf, np.nan]),
    seed=st.integers(0, 2**32 - 1),
)
def test_no_system_makes_a_finite_pose_nan(
    device: str, scale: float, slope: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((1, rng.integers(1, 40), NV))
    with np.errstate(all="ignore"):
        hessian = scale * (np.swapaxes(factor, 1, 2) @ factor)
        gradient = slope * rng.standard_normal((1, NV))
        start = poses_of(rng, 1)
        step, pose = run_solve(
            device, hessian, gradient, np.zeros(1), np.zeros(NV), start,
            max_translation=0.05, max_rotation=0.4, max_angle=0.5,
        )  # fmt: skip
    assert np.isfinite(pose).all()
    assert np.abs(pose[0, :3] - start[0, :3]).max() <= 0.05 + 1e-6
    assert np.abs(pose[0, 7:] - start[0, 7:]).max() <= 0.5 + 1e-6
    assert np.linalg.norm(pose[0, 3:7]) == pytest.approx(1.0, abs=1e-5)
    assert step.shape == (1, NV)


def test_better_poses_are_kept_and_worse_ones_forgotten(device: str, rng) -> None:
    totals = np.array([1.0, 3.0, np.nan, np.inf, 2.0])
    best = np.array([2.0, 2.0, 2.0, 2.0, 2.0])
    accepted = np.array([True, False, False, False, True])
    nrow = len(totals)
    tried = poses_of(rng, nrow), rng.random((nrow, NV, NV)), rng.random((nrow, NV))
    kept = poses_of(rng, nrow), rng.random((nrow, NV, NV)), rng.random((nrow, NV))
    best_totals, damping = upload(best, device), upload(np.full(nrow, 0.1), device)
    stored = [upload(values, device) for values in kept]
    solve.judge_step(
        upload(totals, device), *(upload(values, device) for values in tried),
        shrink=0.5, grow=4.0, least=1e-4, most=1e3, best_totals=best_totals, damping=damping,
        best_pose=stored[0], best_hessian=stored[1], best_gradient=stored[2],
    )  # fmt: skip
    np.testing.assert_array_equal(download(best_totals), np.where(accepted, totals, best))
    np.testing.assert_allclose(download(damping), np.where(accepted, 0.05, 0.4), rtol=1e-6)
    for found, new, old in zip(stored, tried, kept, strict=True):
        where = accepted.reshape(-1, *[1] * (new.ndim - 1))
        np.testing.assert_array_equal(download(found), rounded(np.where(where, new, old)))


def test_damping_stays_within_its_bounds(device: str, rng) -> None:
    zeros = (
        upload(poses_of(rng, 2), device), upload(np.zeros((2, NV, NV)), device),
        upload(np.zeros((2, NV)), device),
    )  # fmt: skip
    damping = upload(np.array([1e-4, 900.0]), device)
    for _ in range(3):
        solve.judge_step(
            upload(np.array([1.0, 3.0]), device), *zeros, shrink=0.5, grow=4.0, least=1e-4,
            most=1e3, best_totals=upload(np.array([2.0, 2.0]), device), damping=damping,
            best_pose=poisoned((2, 28), device), best_hessian=poisoned((2, NV, NV), device),
            best_gradient=poisoned((2, NV), device),
        )  # fmt: skip
    np.testing.assert_allclose(download(damping), [1e-4, 1e3], rtol=1e-6)


def test_a_row_does_not_depend_on_the_others(device: str, rng) -> None:
    hessian, gradient, damping, floors = systems(rng, 7)
    start = poses_of(rng, 7)
    _, together = run_solve(device, hessian, gradient, damping, floors, start)
    for row in (0, 3, 6):
        one = slice(row, row + 1)
        _, alone = run_solve(device, hessian[one], gradient[one], damping[one], floors, start[one])
        np.testing.assert_array_equal(alone[0], together[row])


def test_accumulation_of_a_row_does_not_depend_on_the_others(device: str, rng) -> None:
    rows, values, chains = compact_rows(rng, 7, 300)
    hessian, gradient = accumulate(device, rows, values, chains)
    for row in (0, 6):
        one = slice(row, row + 1)
        h, g = accumulate(device, rows[one], values[one], chains[one])
        np.testing.assert_array_equal(h[0], hessian[row])
        np.testing.assert_array_equal(g[0], gradient[row])


def test_sizes_of_the_kernels_are_those_of_the_skeleton() -> None:
    assert skeleton.NV == solve.NV
    assert NLOCAL == 6 + max(np.bincount([finger_of_bone(b) for b in skeleton.ANGLE_BONES]))
