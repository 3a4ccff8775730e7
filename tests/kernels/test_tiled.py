"""The tiled kernels, which run on CUDA only, agree with the plain ones; on a CPU block by block."""

import numpy as np
import pytest
import warp as wp

from handtrack.kernels import score, solve
from handtrack.kernels.render import EMPTY
from handtrack.kernels.residuals import vec11

NROW, NSLOT = 3, 500


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def tiled(kernel, dim, inputs, outputs, device):
    wp.launch_tiled(
        kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=solve.LANES, device=device
    )


def test_chain_sums_agree(device, rng):
    rows = wp.array(rng.standard_normal((NROW, NSLOT, 11)), dtype=vec11, device=device)
    residuals = wp.array(rng.standard_normal((NROW, NSLOT)), dtype=float, device=device)
    chains = wp.array(rng.integers(-2, 5, (NROW, NSLOT)), dtype=int, device=device)
    found = []
    for use_tiles in (False, True):
        hessians = wp.full((NROW, 5), solve.mat11(np.nan), dtype=solve.mat11, device=device)
        gradients = wp.full((NROW, 5), vec11(np.nan), dtype=vec11, device=device)
        inputs, outputs = [rows, residuals, chains], [hessians, gradients]
        if use_tiles:
            tiled(solve._accumulate_chains_tiled, (NROW, 5), inputs, outputs, device)
        else:
            wp.launch(
                solve._accumulate_chains, dim=NROW, inputs=inputs, outputs=outputs, device=device
            )
        found.append((hessians.numpy(), gradients.numpy()))
    for plain, blocked in zip(*found, strict=True):
        np.testing.assert_allclose(blocked, plain, rtol=1e-4, atol=1e-3)


def test_cost_sums_agree(device, rng):
    costs = rng.random((NROW, NSLOT)).astype(np.float32)
    totals = wp.full(NROW, np.nan, dtype=float, device=device)
    tiled(solve._sum_costs_tiled, (NROW,), [wp.array(costs, device=device)], [totals], device)
    np.testing.assert_allclose(totals.numpy(), costs.sum(1), rtol=1e-5)


def test_cholesky_solves_agree_with_numpy(device, rng):
    jacobian = rng.standard_normal((NROW, 60, solve.NV))
    system = np.einsum("rsi,rsj->rij", jacobian, jacobian)
    gradient = rng.standard_normal((NROW, solve.NV))
    step = wp.full((NROW, solve.NV), np.nan, dtype=float, device=device)
    inputs = [
        wp.array(system, dtype=float, device=device),
        wp.array(gradient, dtype=float, device=device),
    ]
    tiled(solve._solve_cholesky_tiled, (NROW,), inputs, [step], device)
    expected = np.linalg.solve(system, gradient[..., None])[..., 0]
    np.testing.assert_allclose(step.numpy(), expected, rtol=1e-3, atol=1e-5)


def test_depth_scores_agree(device, rng):
    m, scale = 16, 2
    keys = np.full((NROW, m, m), EMPTY, np.int64)
    drawn = rng.random(keys.shape) < 0.4
    depth = rng.uniform(0.4, 0.5, keys.shape).astype(np.float32)
    keys[drawn] = depth.view(np.int32).astype(np.int64)[drawn] << 32
    cells = rng.uniform(0.4, 0.5, (1, m * scale, m * scale)).astype(np.float32)
    cells[rng.random(cells.shape) < 0.4] = 0.0
    cells[rng.random(cells.shape) < 0.1] = np.inf
    points = rng.uniform(-0.1, 0.5, (*cells.shape, 3))
    put = {"device": device}
    inputs = [
        wp.zeros(NROW, dtype=int, **put),
        wp.array(keys, dtype=wp.int64, **put),
        wp.array(cells, dtype=float, **put),
        wp.array(points, dtype=wp.vec3, **put),
        wp.array(np.tile(np.eye(3), (NROW, 16, 1, 1)), dtype=wp.mat33, **put),
        wp.zeros((NROW, 16), dtype=wp.vec3, **put),
        scale, 0.04, 0.0,
    ]  # fmt: skip
    found = []
    for use_tiles in (False, True):
        outputs = [wp.full(NROW, np.nan, dtype=float, **put), wp.full(NROW, -1, dtype=int, **put)]
        if use_tiles:
            tiled(score._score_depth_tiled, (NROW,), inputs, outputs, device)
        else:
            wp.launch(score._score_depth, dim=NROW, inputs=inputs, outputs=outputs, device=device)
        found.append([output.numpy() for output in outputs])
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-5)
    np.testing.assert_array_equal(found[1][1], found[0][1])
    assert (found[0][1] > 0).all()
