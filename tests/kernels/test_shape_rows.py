"""Rows by the shape against central differences of float64 skinning, and their sums."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.hand.kinematics import skin
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import NBONE
from handtrack.kernels import shape_rows as kernel
from handtrack.kernels.residuals import vec11
from oracles.device_arrays import download, poisoned, upload
from oracles.scenes import hand_model

FLOAT32 = 2e-6
"""Entries are lengths below a quarter of a metre."""

STEP = 1e-4

Float = NDArray[np.float64]


def vertex_differences(pose: Float, side: str) -> Float:
    """d vertices / d unknowns of the mean hand, shape (nvert, 3, nshape)."""
    model = hand_model()
    columns = []
    for unknown in range(1 + model.nalpha + model.nbeta):
        ends = []
        for step in (STEP, -STEP):
            move = np.zeros(1 + model.nalpha + model.nbeta)
            move[unknown] = step
            shape = HandShape(
                scale=float(np.exp(move[0])), alpha=move[1 : 1 + model.nalpha],
                beta=move[1 + model.nalpha :],
            )  # fmt: skip
            ends.append(skin(model.shaped(shape, side=side), pose))
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    return np.stack(columns, -1)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("directions", [1, 3])
def test_rows_equal_central_differences(make_posed, device, rng, side, directions) -> None:
    posed = make_posed(device, side=side, seed=5, bend=0.8, turn=1.0, row_hand=(0, 0))
    nvert, npoint = posed.nvert, 300
    matches = rng.integers(0, nvert, (2, npoint))
    nslot = npoint * directions + nvert
    rows = rng.standard_normal((2, nslot, 11))
    chains = np.where(rng.random((2, nslot)) < 0.7, rng.integers(0, 5, (2, nslot)), -2)
    matches[chains[:, : npoint * directions : directions] < 0] = -1
    chains[:, : npoint * directions] = np.repeat(np.where(matches < 0, -2, 1), directions, 1)
    unknowns = ShapeUnknowns(hand_model(), side=side)
    steps = unknowns.steps(np.zeros(unknowns.count))
    found = poisoned((2, nslot, unknowns.count), device)
    kernel.shape_rows(
        posed.model.bone_parents, posed.model.weight_bones, posed.model.weights,
        upload(steps.joints, device, wp.vec3), upload(steps.vertices, device, wp.vec3),
        posed.rotations, upload(matches, device), upload(rows, device, vec11),
        upload(chains, device), directions=directions,
        origin_steps=poisoned((2, NBONE, unknowns.count), device, wp.vec3), shape_rows=found,
    )  # fmt: skip
    found = download(found)
    for row in range(2):
        moved = vertex_differences(posed.poses[row], side)
        vertex = np.concatenate([np.repeat(matches[row], directions), np.arange(nvert)])
        used = chains[row] >= 0
        expected = np.einsum("si,sik->sk", rows[row][used, :3], moved[vertex[used]])
        np.testing.assert_allclose(found[row][used], expected, atol=FLOAT32)
        # Every unknown moves something.
        assert (np.abs(expected).max(axis=0) > 100 * FLOAT32).all()
        assert np.isnan(found[row][~used]).all()


def test_products_are_sums_over_the_residuals_that_are_there(device, rng) -> None:
    nrow, nslot, count = 3, 101, 7
    shapes = rng.standard_normal((nrow, nslot, count))
    rows = rng.standard_normal((nrow, nslot, 11))
    values = rng.standard_normal((nrow, nslot))
    chains = rng.integers(-2, 5, (nrow, nslot))
    shapes[chains < 0] = np.nan
    columns = count + 1 + 55
    products = poisoned((nrow, count, columns), device)
    kernel.accumulate_shape(
        upload(shapes, device), upload(rows, device, vec11), upload(values, device),
        upload(chains, device), sums=poisoned((nrow, kernel.PARTS, count, columns), device),
        products=products,
    )  # fmt: skip
    found = download(products)
    for row in range(nrow):
        used = chains[row] >= 0
        mine = shapes[row][used]
        tolerance = {"atol": 1e-4}
        np.testing.assert_allclose(
            np.tril(found[row, :, :count]), np.tril(mine.T @ mine), **tolerance
        )
        np.testing.assert_allclose(found[row, :, count], mine.T @ values[row][used], **tolerance)
        for chain in range(5):
            own = chains[row] == chain
            first = count + 1 + 11 * chain
            np.testing.assert_allclose(
                found[row, :, first : first + 11], shapes[row][own].T @ rows[row][own], **tolerance
            )
