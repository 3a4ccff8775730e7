"""Depth error E_d (Eq. II.19) and the choice of the best row."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.kernels.render import EMPTY
from handtrack.kernels.score import score_depth
from oracles.depth_score import depth_error
from oracles.device_arrays import download, poisoned, upload
from oracles.scenes import rounded

Float = NDArray[np.float64]

CAP = 0.04
SIZE = 20


def keys_of(depth: Float) -> NDArray[np.int64]:
    """Z-buffer keys of depth images; 0 = nothing drawn."""
    bits = depth.astype(np.float32).view(np.int32).astype(np.int64)
    items = np.arange(depth.size).reshape(depth.shape) % 3000
    return np.where(depth > 0, bits << 32 | items, EMPTY)


def observed(rng: np.random.Generator, nhand: int, scale: int) -> tuple[Float, Float]:
    """Cells of every kind and their points."""
    n = SIZE * scale
    cells = rng.uniform(0.35, 0.45, (nhand, n, n))
    kind = rng.random(cells.shape)
    cells[kind < 0.3] = 0.0
    cells[(kind > 0.3) & (kind < 0.45)] = np.inf
    points = rng.uniform(-0.1, 0.1, (*cells.shape, 3))
    points[..., 2] = np.where(np.isfinite(cells), cells, 0.0)
    return rounded(cells), rounded(points)


def score(
    posed, device: str, rendered: Float, cells: Float, points: Float, scale: int, wrist_x: float
) -> tuple[Float, NDArray]:
    errors = poisoned(posed.nrow, device)
    counts = poisoned(posed.nrow, device, int)
    score_depth(
        posed.rows, upload(keys_of(rendered), device, wp.int64), upload(cells, device),
        upload(points, device, wp.vec3), posed.rotations, posed.origins,
        scale=scale, cap=CAP, wrist_x=wrist_x, errors=errors, counts=counts,
    )  # fmt: skip
    return download(errors), download(counts)


@pytest.mark.parametrize("scale", [1, 2, 3])
@pytest.mark.parametrize("side", ["right", "left"])
def test_scores_equal_the_oracle(make_posed, device, rng, side, scale) -> None:
    posed = make_posed(device, side=side, seed=61, distance=0.4)
    cells, points = observed(rng, 2, scale)
    rendered = rng.uniform(0.36, 0.44, (posed.nrow, SIZE, SIZE))
    rendered[rng.random(rendered.shape) < 0.4] = 0.0
    rendered = rounded(rendered)
    for wrist_x in (-10.0, 0.0, 0.05):
        errors, counts = score(posed, device, rendered, cells, points, scale, wrist_x)
        for row, hand in enumerate(posed.row_hand):
            error, count = depth_error(
                rendered[row], cells[hand], points[hand], posed.palm(row), scale=scale, cap=CAP,
                wrist_x=wrist_x,
            )  # fmt: skip
            assert counts[row] == count
            assert errors[row] == pytest.approx(error, rel=1e-4)
            assert 0 < error < CAP


def test_the_same_picture_has_no_error(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=62)
    cells, points = observed(rng, 2, 1)
    rendered = np.where(np.isfinite(cells), cells, 0.0)[list(posed.row_hand)]
    errors, counts = score(posed, device, rendered, cells, points, 1, -10.0)
    np.testing.assert_array_equal(errors, 0.0)
    np.testing.assert_array_equal(
        counts, [((c > 0) & np.isfinite(c)).sum() for c in cells[list(posed.row_hand)]]
    )


def test_a_pose_nowhere_near_the_hand_has_the_largest_error(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=63)
    cells, points = observed(rng, 2, 1)
    nothing = np.zeros((posed.nrow, SIZE, SIZE))
    errors, counts = score(posed, device, nothing, cells, points, 1, -10.0)
    np.testing.assert_allclose(errors, CAP, rtol=1e-6)
    assert (counts > 0).all()
    errors, counts = score(posed, device, nothing, np.zeros_like(cells), points, 1, -10.0)
    np.testing.assert_allclose(errors, CAP, rtol=1e-6)
    np.testing.assert_array_equal(counts, 0)


def test_a_nan_pose_scores_worst_and_spares_the_others(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=64)
    cells, points = observed(rng, 2, 1)
    rendered = np.where(np.isfinite(cells), cells, 0.0)[list(posed.row_hand)]
    rendered[1] = 0.0
    for array in (posed.rotations, posed.origins):
        host = array.numpy().copy()
        host[1] = np.nan
        array.assign(host)
    errors, _ = score(posed, device, rendered, cells, points, 1, -10.0)
    np.testing.assert_allclose(errors, [0.0, CAP, 0.0], rtol=1e-6)
