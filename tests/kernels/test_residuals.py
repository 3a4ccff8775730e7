"""Residual kernels: energies, and Jacobian rows against central differences on the manifold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.kernels import residuals
from handtrack.kernels.crop import CROP_SIZE, scan_columns
from handtrack.kernels.residuals import vec11
from oracles.correspondence import facing, pixels
from oracles.device_arrays import GARBAGE, download, poisoned, upload
from oracles.energy import (
    dense_rows,
    differences,
    geman_mcclure,
    geman_mcclure_weight,
    vertex_jacobian,
)
from oracles.image import squared_distances
from oracles.scenes import rounded

FLOAT32 = 1e-5
"""Entries of unweighted rows are lengths below half a metre; float32 chains lose a few digits."""
ROW_AND_RESIDUAL = 1e-4
"""As `FLOAT32`, with pixel coordinates behind the direction."""
SIZE = 48
"""One point per vertex and some over, so that every vertex is matched."""

Float = NDArray[np.float64]

_jacobians: dict = {}


def jacobian_of(posed, row: int) -> Float:
    """d vertices / d increment of a row; slow, so kept."""
    key = (posed.hand(row).side, posed.row_hand[row], posed.poses[row].tobytes())
    if key not in _jacobians:
        _jacobians[key] = vertex_jacobian(posed.hand(row), posed.poses[row])
    return _jacobians[key]


@cache
def matches_of(nvert: int) -> NDArray[np.int64]:
    """Every vertex once, then some unmatched points and some that are not the hand's."""
    matches = np.full(SIZE * SIZE, -2)
    matches[:nvert] = np.arange(nvert)
    matches[nvert : nvert + 20] = -1
    return np.random.default_rng(0).permutation(matches)


@dataclass(kw_only=True)
class PointTerms:
    """What the kernel wrote, and its inputs."""

    rows: Float
    residuals: Float
    chains: NDArray
    costs: Float
    points: Float
    matches: NDArray
    spare: int


def run_points(
    posed, device: str, rng: np.random.Generator, *, noise: float, **options: float
) -> PointTerms:
    """Rows for observed points near all vertices of hand and row."""
    matches = matches_of(posed.nvert)
    directions = int(options["directions"])
    points = np.zeros((len(posed.hands), SIZE * SIZE, 3))
    for hand in range(len(posed.hands)):
        vertices, _ = posed.skin(posed.row_hand.index(hand))
        points[hand] = vertices[np.maximum(matches, 0)]
    points = rounded(points + noise * rng.standard_normal(points.shape))
    # Slots beyond the points belong to other terms and must stay as they are.
    spare = 7
    nslot = SIZE * SIZE * directions + spare
    rows = poisoned((posed.nrow, nslot), device, vec11)
    values = poisoned((posed.nrow, nslot), device)
    chains = poisoned((posed.nrow, nslot), device, int)
    costs = poisoned((posed.nrow, SIZE * SIZE + spare), device)
    model = posed.model
    residuals.point_rows(
        model.weight_bones, model.weights, model.local_vertices, model.vertex_chains,
        model.angle_bones, posed.rows,
        upload(points.reshape(-1, SIZE, SIZE, 3), device, wp.vec3),
        upload(np.tile(matches, (posed.nrow, 1)), device), posed.vertices, posed.normals,
        posed.rotations, posed.origins, posed.axes,
        stride=1, rows=rows, residuals=values, chains=chains, costs=costs, **options,
    )  # fmt: skip
    return PointTerms(
        rows=download(rows), residuals=download(values), chains=download(chains),
        costs=download(costs), points=points, matches=matches, spare=spare,
    )  # fmt: skip


@pytest.mark.parametrize("side", ["right", "left"])
def test_plane_rows_equal_central_differences_for_every_vertex(
    make_posed, device, rng, side
) -> None:
    posed = make_posed(device, side=side, seed=21, bend=1.0, turn=2.0)
    weight, scale = 4.0, 0.02
    terms = run_points(
        posed, device, rng, noise=0.01, directions=1, tangent_weight=0.0, weight=weight,
        robust_scale=scale, max_distance=0.04,
    )  # fmt: skip
    matched = terms.matches >= 0
    vertex = terms.matches[matched]
    for row in range(posed.nrow):
        vertices, normals = posed.skin(row)
        gap = vertices[vertex] - terms.points[posed.row_hand[row]][matched]
        root = np.sqrt(weight * geman_mcclure_weight((gap**2).sum(1), scale))
        used = np.flatnonzero(matched)
        chains = terms.chains[row, used]
        assert (chains >= 0).all() and (chains < 5).all()
        expected = np.einsum("p,pi,pij->pj", root, normals[vertex], jacobian_of(posed, row)[vertex])
        found = dense_rows(terms.rows[row, used], chains)
        np.testing.assert_allclose(found, expected, atol=weight * FLOAT32)
        np.testing.assert_allclose(
            terms.residuals[row, used], root * (gap * normals[vertex]).sum(1), atol=FLOAT32
        )
        # Every finger and the palm have been looked at.
        assert set(chains) == set(range(5))
        assert (np.abs(expected[:, 6:]).max(0) > 20 * FLOAT32).all()


def test_three_directions_span_the_distance(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=22, bend=0.7)
    tangent, weight, scale = 0.3, 2.0, 0.015
    terms = run_points(
        posed, device, rng, noise=0.01, directions=3, tangent_weight=tangent, weight=weight,
        robust_scale=scale, max_distance=0.04,
    )  # fmt: skip
    used = np.flatnonzero(terms.matches >= 0)
    vertex = terms.matches[used]
    slots = used[:, None] * 3 + np.arange(3)
    for row in range(posed.nrow):
        vertices, normals = posed.skin(row)
        gap = vertices[vertex] - terms.points[posed.row_hand[row]][used]
        root = np.sqrt(weight * geman_mcclure_weight((gap**2).sum(1), scale))
        factors = root[:, None] * [1.0, np.sqrt(tangent), np.sqrt(tangent)]
        # The derivative by translation is the direction itself.
        directions = terms.rows[row][slots][..., :3] / factors[..., None]
        np.testing.assert_allclose(
            directions @ np.swapaxes(directions, 1, 2), np.tile(np.eye(3), (len(used), 1, 1)),
            atol=1e-5,
        )  # fmt: skip
        np.testing.assert_allclose(directions[:, 0], normals[vertex], atol=1e-4)
        for k in range(3):
            expected = np.einsum(
                "p,pi,pij->pj", factors[:, k], directions[:, k], jacobian_of(posed, row)[vertex]
            )
            chains = terms.chains[row][slots[:, k]]
            found = dense_rows(terms.rows[row][slots[:, k]], chains)
            np.testing.assert_allclose(found, expected, atol=weight * FLOAT32)
            np.testing.assert_allclose(
                terms.residuals[row][slots[:, k]],
                factors[:, k] * (gap * directions[:, k]).sum(1),
                atol=FLOAT32,
            )


@pytest.mark.parametrize("tangent", [0.0, 0.4, 1.0])
def test_energies_equal_the_oracle(make_posed, device, rng, tangent) -> None:
    posed = make_posed(device, seed=23)
    weight, scale, far = 3.0, 0.015, 0.04
    directions = 3 if tangent else 1
    terms = run_points(
        posed, device, rng, noise=0.01, directions=directions, tangent_weight=tangent,
        weight=weight, robust_scale=scale, max_distance=far,
    )  # fmt: skip
    npoint = SIZE * SIZE
    for row in range(posed.nrow):
        vertices, normals = posed.skin(row)
        vertex = np.maximum(terms.matches, 0)
        gap = vertices[vertex] - terms.points[posed.row_hand[row]]
        squared = (gap**2).sum(1)
        plane = (gap * normals[vertex]).sum(1) ** 2
        # Geman-McClure of the whole distance shared out between plane and tangent.
        share = (plane + tangent * (squared - plane)) / squared
        expected = weight * geman_mcclure(squared, scale) * share
        expected[terms.matches == -1] = weight * geman_mcclure(np.float64(far**2), scale)
        expected[terms.matches == -2] = 0.0
        np.testing.assert_allclose(
            terms.costs[row, :npoint], expected, rtol=2e-3, atol=weight * 1e-8
        )
    assert np.isnan(terms.costs[:, npoint:]).all()


def test_unmatched_points_have_no_rows_and_other_slots_stay(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=24)
    for directions in (1, 3):
        terms = run_points(
            posed, device, rng, noise=0.01, directions=directions, tangent_weight=0.5, weight=1.0,
            robust_scale=0.02, max_distance=0.04,
        )  # fmt: skip
        npoint = SIZE * SIZE
        chains = terms.chains[:, : npoint * directions].reshape(posed.nrow, npoint, directions)
        assert (chains[:, terms.matches < 0] == -2).all()
        assert (chains[:, terms.matches >= 0] >= 0).all()
        assert (terms.chains[:, npoint * directions :] == GARBAGE).all()
        assert np.isnan(terms.rows[:, npoint * directions :]).all()
        written = np.repeat(terms.matches >= 0, directions)
        assert np.isfinite(terms.rows[:, : npoint * directions][:, written]).all()
        assert np.isfinite(terms.residuals[:, : npoint * directions][:, written]).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_gradient_is_half_the_slope_of_the_energy(make_posed, device, rng, side) -> None:
    # Point-to-point: reweighting gives the exact gradient of the robust energy.
    posed = make_posed(device, side=side, seed=25, bend=0.8)
    weight, scale = 2.0, 0.015
    terms = run_points(
        posed, device, rng, noise=0.01, directions=3, tangent_weight=1.0, weight=weight,
        robust_scale=scale, max_distance=0.04,
    )  # fmt: skip
    used = terms.matches >= 0
    for row in range(posed.nrow):
        hand, points = posed.hand(row), terms.points[posed.row_hand[row]][used]

        def energy(pose: Float, hand=hand, points=points) -> Float:
            gap = skin(hand, pose)[terms.matches[used]] - points
            return weight * geman_mcclure((gap**2).sum(1), scale).sum()

        live = terms.chains[row] >= 0
        rows = dense_rows(terms.rows[row, live], terms.chains[row, live])
        gradient = rows.T @ terms.residuals[row, live]
        slope = differences(energy, posed.poses[row])
        np.testing.assert_allclose(gradient, slope / 2, rtol=2e-3, atol=2e-5 * np.abs(slope).max())


NCELL = 48


@dataclass(kw_only=True)
class ImageTerms:
    """What the silhouette kernel wrote, its inputs and options."""

    rows: Float
    residuals: Float
    chains: NDArray
    costs: Float
    crops: Float
    cells: Float
    options: dict


def run_image(
    posed, device: str, rng: np.random.Generator, *, aspect: float, **changed
) -> ImageTerms:
    """Rows where an image of blocks contradicts the posed hands."""
    options = {
        "reach": 9, "silhouette_weight": 3.0, "silhouette_scale": 0.03, "silhouette_margin": 0.002,
        "front_weight": 2.0, "front_scale": 0.02, "front_margin": 0.005, **changed,
    }  # fmt: skip
    nhand = len(posed.hands)
    crops = np.zeros((nhand, CROP_SIZE))
    crops[:, 0] = NCELL * 0.45 / 0.24
    crops[:, 1] = crops[:, 0] * aspect
    crops[:, 2:4] = (NCELL - 1) / 2 + rng.uniform(-2, 2, (nhand, 2))
    crops = rounded(crops)
    # Blocks of background and of surfaces around the hand's depth; the left third is empty.
    blocks = np.where(
        rng.random((nhand, 12, 12)) < 0.35, 0.0, rng.uniform(0.38, 0.5, (nhand, 12, 12))
    )
    cells = np.kron(blocks, np.ones((4, 4)))
    cells[:, :, : NCELL // 3] = 0.0
    cells[:, 5, 10] = 0.4
    cells[rng.random(cells.shape) < 0.03] = np.inf
    cells = rounded(cells)
    nearest = poisoned(cells.shape, device, int)
    device_cells = upload(cells, device)
    scan_columns(device_cells, nearest=nearest)
    first = 5
    nslot, ncost = first + posed.nvert + 3, first + posed.nvert + 3
    rows = poisoned((posed.nrow, nslot), device, vec11)
    values = poisoned((posed.nrow, nslot), device)
    chains = poisoned((posed.nrow, nslot), device, int)
    costs = poisoned((posed.nrow, ncost), device)
    model = posed.model
    residuals.silhouette_rows(
        model.weight_bones, model.weights, model.local_vertices, model.vertex_chains,
        model.vertex_is_hand, model.angle_bones, posed.rows, upload(crops, device), device_cells,
        nearest, posed.vertices, posed.normals, posed.rotations, posed.origins, posed.axes,
        first_slot=first, first_cost=first,
        rows=rows, residuals=values, chains=chains, costs=costs, **options,
    )  # fmt: skip
    part = slice(first, first + posed.nvert)
    outside = np.delete(np.arange(nslot), part)
    assert (download(chains)[:, outside] == GARBAGE).all()
    assert np.isnan(download(costs)[:, outside]).all()
    return ImageTerms(
        rows=download(rows)[:, part], residuals=download(values)[:, part],
        chains=download(chains)[:, part], costs=download(costs)[:, part],
        crops=crops, cells=cells, options=options,
    )  # fmt: skip


def judge_vertices(posed, row: int, terms: ImageTerms) -> NDArray[np.str_]:
    """What the image says about each vertex.

    "skip": says nothing about it; "free": nothing against it; "front": before what was seen;
    "outside": on background near something; "lost": on background far from everything;
    "unsure": so near a border between these that float32 rounding decides.
    """
    cells, crop = terms.cells[posed.row_hand[row]], terms.crops[posed.row_hand[row]]
    vertices, normals = download(posed.vertices)[row], download(posed.normals)[row]
    uv = pixels(vertices, crop) + 0.5
    cosine = (vertices * normals).sum(1) / np.linalg.norm(vertices, axis=1)
    # Which vertices are the forearm stub's is shared by all hands, as the topology is.
    hand = posed.hands[0]
    palm_x = np.where(hand.weight_bones == 0, hand.local_vertices[..., 0], np.inf).min(1)
    squared = squared_distances(cells)
    verdicts = np.full(posed.nvert, "skip", "<U8")
    for vertex in np.flatnonzero((palm_x > 0) & facing(vertices, normals)):
        column, line = np.floor(uv[vertex]).astype(int)
        if not (0 <= column < NCELL and 0 <= line < NCELL) or np.isinf(cells[line, column]):
            continue
        before = cells[line, column] - vertices[vertex, 2] - terms.options["front_margin"]
        if cells[line, column] > 0:
            verdicts[vertex] = "front" if before > 0 else "free"
            if abs(before) < 1e-6:
                verdicts[vertex] = "unsure"
        else:
            near = squared[line, column] <= terms.options["reach"] ** 2
            verdicts[vertex] = "outside" if near else "lost"
    at_border = (np.abs(uv - np.round(uv)) < 1e-3).any(1) | (np.abs(cosine) < 1e-5)
    verdicts[at_border & (palm_x > 0)] = "unsure"
    return verdicts


def nearest_cells(posed, row: int, terms: ImageTerms, vertex: int) -> tuple[Float, Float]:
    """All equally near filled cells (column, row) to a vertex' own cell, and the vertex' pixel."""
    cells, crop = terms.cells[posed.row_hand[row]], terms.crops[posed.row_hand[row]]
    uv = pixels(posed.skin(row)[0][vertex : vertex + 1], crop)[0]
    filled = np.argwhere(cells > 0)[:, ::-1]
    squared = ((filled - np.floor(uv + 0.5)) ** 2).sum(1)
    return filled[squared == squared.min()].astype(float), uv


@pytest.mark.parametrize("aspect", [1.0, 1.25], ids=["square pixels", "oblong pixels"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_silhouette_rows_equal_central_differences(make_posed, device, rng, side, aspect) -> None:
    posed = make_posed(device, side=side, seed=26, bend=0.6, turn=0.3)
    terms = run_image(posed, device, rng, aspect=aspect)
    weight, scale = terms.options["silhouette_weight"], terms.options["silhouette_scale"]
    checked = 0
    for row in range(posed.nrow):
        crop = terms.crops[posed.row_hand[row]]
        vertices, _ = posed.skin(row)
        verdicts = judge_vertices(posed, row, terms)
        for vertex in np.flatnonzero(verdicts == "outside"):
            x, y, z = vertices[vertex]
            candidates, uv = nearest_cells(posed, row, terms, vertex)
            # d pixel / d vertex; metres per cell are held, as the robust weight is.
            projection = np.array(
                [[crop[0] / z, 0, -crop[0] * x / z**2], [0, crop[1] / z, -crop[1] * y / z**2]]
            )
            errors = []
            for target in candidates:
                length = np.linalg.norm(uv - target)
                over = length * z / crop[0] - terms.options["silhouette_margin"]
                chain = terms.chains[row, vertex : vertex + 1]
                if over <= 0 or chain[0] < 0:
                    silent = over <= 0 and chain[0] < 0
                    errors.append(abs(terms.costs[row, vertex]) if silent else np.inf)
                    continue
                root = np.sqrt(weight * geman_mcclure_weight(over**2, scale))
                slope = (uv - target) / length @ projection * z / crop[0]
                found = dense_rows(terms.rows[row, vertex : vertex + 1], chain)[0]
                cost = weight * geman_mcclure(over**2, scale)
                errors.append(
                    np.abs(found - root * slope @ jacobian_of(posed, row)[vertex]).max() / weight
                    + abs(terms.residuals[row, vertex] - root * over)
                    + abs(terms.costs[row, vertex] - cost)
                )
            # Any of equally near cells will do, but one must explain row, residual and energy.
            assert min(errors) < ROW_AND_RESIDUAL, (row, vertex)
            checked += 1
    assert checked > 200


@pytest.mark.parametrize("side", ["right", "left"])
def test_rows_of_vertices_in_front_equal_central_differences(make_posed, device, rng, side) -> None:
    posed = make_posed(device, side=side, seed=27, bend=0.6, turn=0.3)
    terms = run_image(posed, device, rng, aspect=1.0)
    weight, scale = terms.options["front_weight"], terms.options["front_scale"]
    checked = 0
    for row in range(posed.nrow):
        cells, crop = terms.cells[posed.row_hand[row]], terms.crops[posed.row_hand[row]]
        vertices, _ = posed.skin(row)
        verdicts = judge_vertices(posed, row, terms)
        front = np.flatnonzero(verdicts == "front")
        column, line = np.floor(pixels(vertices[front], crop) + 0.5).astype(int).T
        # z of the vertex minus where it may begin: it must grow until nothing is in front.
        residual = vertices[front, 2] - cells[line, column] + terms.options["front_margin"]
        root = np.sqrt(weight * geman_mcclure_weight(residual**2, scale))
        expected = root[:, None] * jacobian_of(posed, row)[front, 2]
        chains = terms.chains[row, front]
        assert (chains >= 0).all()
        found = dense_rows(terms.rows[row, front], chains)
        np.testing.assert_allclose(found, expected, atol=weight * FLOAT32)
        np.testing.assert_allclose(terms.residuals[row, front], root * residual, atol=FLOAT32)
        np.testing.assert_allclose(
            terms.costs[row, front],
            weight * geman_mcclure(residual**2, scale),
            rtol=1e-3,
            atol=1e-8,
        )
        checked += len(front)
    assert checked > 200


def test_vertices_that_the_image_allows_cost_nothing(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=28, bend=0.6)
    terms = run_image(posed, device, rng, aspect=1.0, reach=3)
    full = terms.options["silhouette_weight"] * 1.0
    kinds = set()
    for row in range(posed.nrow):
        verdicts = judge_vertices(posed, row, terms)
        kinds |= set(verdicts)
        allowed = np.isin(verdicts, ["skip", "free"])
        np.testing.assert_array_equal(terms.costs[row, allowed], 0.0)
        assert (terms.chains[row, allowed] == -2).all()
        lost = verdicts == "lost"
        # Too far from anything to be pulled, but still counted, at the price of the last pull.
        z = posed.skin(row)[0][lost, 2]
        cell = z / terms.crops[posed.row_hand[row], 0]
        over = terms.options["reach"] * cell - terms.options["silhouette_margin"]
        expected = full * geman_mcclure(over**2, terms.options["silhouette_scale"])
        np.testing.assert_allclose(terms.costs[row, lost], expected, rtol=1e-3)
        assert (terms.chains[row, lost] == -2).all()
    assert kinds >= {"skip", "free", "front", "lost", "outside"}


@pytest.mark.parametrize("off", ["silhouette_weight", "front_weight"])
def test_a_term_without_weight_writes_no_rows(make_posed, device, rng, off) -> None:
    posed = make_posed(device, seed=29, bend=0.6)
    terms = run_image(posed, device, rng, aspect=1.0, **{off: 0.0})
    silent = {"silhouette_weight": ["outside", "lost"], "front_weight": ["front"]}[off]
    for row in range(posed.nrow):
        verdicts = judge_vertices(posed, row, terms)
        without = np.isin(verdicts, silent)
        assert without.any()
        np.testing.assert_array_equal(terms.costs[row, without], 0.0)
        assert (terms.chains[row, without] == -2).all()
        assert (terms.chains[row, ~without] >= 0).any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e30])
def test_garbage_vertices_write_no_rows(make_posed, device, rng, bad) -> None:
    posed = make_posed(device, seed=30)
    posed.vertices.assign(np.full_like(posed.vertices.numpy(), bad))
    terms = run_image(posed, device, rng, aspect=1.0)
    assert (terms.chains == -2).all()
    np.testing.assert_array_equal(terms.costs, 0.0)
