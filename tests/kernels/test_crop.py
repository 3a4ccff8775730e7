"""Crop kernels: what a cell shows, the distance transform and the observed normals."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtrack.kernels.crop import CROP_SIZE, GATE_SIZE, crop_depth, estimate_normals, scan_columns
from oracles.device_arrays import download, poisoned, upload
from oracles.image import crop_cells, nearest_in_column, squared_distances, surface_normals
from oracles.scenes import rounded

FLOAT32 = 1e-6
"""Float32 means of depths below a metre [m]."""
SAME_SURFACE = 0.015
CAMERA = np.array([30.0, 31.0, 12.5, 14.0])
WIDE_GATE = np.array([0.0, 0.0, 0.5, 10.0])

Float = NDArray[np.float64]


def crop_row(x0: float, y0: float, step: float) -> Float:
    """Crop parameters of a grid whose first cell lies at a pixel."""
    crop = np.zeros(CROP_SIZE)
    crop[:4] = (*(CAMERA[:2] / step), (CAMERA[2] - x0) / step, (CAMERA[3] - y0) / step)
    crop[4:7] = x0, y0, step
    return crop


def run_crop(
    device: str, depth: Float, crops: Float, gates: Float, size: int
) -> tuple[Float, Float]:
    """Cells and points of all hands."""
    depth = np.atleast_3d(depth).reshape(-1, *depth.shape[-2:])
    assert gates.shape[-1] == GATE_SIZE
    cells = poisoned((len(depth), size, size), device)
    points = poisoned((len(depth), size, size), device, wp.vec3)
    crop_depth(
        upload(depth, device), upload(CAMERA, device), upload(np.atleast_2d(crops), device),
        upload(np.atleast_2d(gates), device),
        same_surface=SAME_SURFACE, cells=cells, points=points,
    )  # fmt: skip
    return download(cells), download(points)


def patchwork(rng: np.random.Generator, height: int, width: int) -> Float:
    """A depth image with surfaces, edges, holes, stray pixels and values no sensor should give."""
    depth = np.full((height, width), 0.0)
    for _ in range(6):
        top, left = rng.integers(0, height - 6), rng.integers(0, width - 6)
        tilt = rng.uniform(-0.004, 0.004, 2)
        v, u = np.mgrid[:12, :12]
        patch = rng.uniform(0.3, 0.8) + tilt[0] * u + tilt[1] * v
        patch = patch[: height - top, : width - left]
        depth[top : top + 12, left : left + 12] = patch
    noise = rng.random(depth.shape)
    depth[noise < 0.06] = 0.0
    depth[(noise > 0.06) & (noise < 0.09)] = rng.uniform(0.2, 0.9)
    odd = rng.choice(depth.size, 12, replace=False)
    depth.flat[odd] = np.tile([np.nan, -1.0, np.inf, 1e30], 3)
    return rounded(depth)


@pytest.mark.parametrize("step", [1.0, 1.5, 2.25])
@pytest.mark.parametrize("seed", [0, 1])
def test_crop_equals_the_oracle(device: str, step: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.stack([patchwork(rng, 29, 26) for _ in range(2)])
    crops = np.stack([crop_row(-3.25, 2.5, step), crop_row(8.0, -4.75, step)])
    gates = rounded(np.array([[0.0, 0.05, 0.5, 0.2], [0.0, 0.0, 0.6, 0.3]]))
    cells, points = run_crop(device, depth, crops, gates, 20)
    for hand in range(2):
        expected, expected_points = crop_cells(
            depth[hand], CAMERA, crops[hand], gates[hand], 20, same_surface=SAME_SURFACE
        )
        # All kinds of cell occur, or the test would say little.
        assert (expected == 0).any() and np.isinf(expected).any()
        assert ((expected > 0) & np.isfinite(expected)).any()
        np.testing.assert_allclose(cells[hand], expected, atol=FLOAT32, rtol=FLOAT32)
        measured = (expected > 0) & np.isfinite(expected)
        np.testing.assert_allclose(
            points[hand][measured], expected_points[measured], atol=FLOAT32, rtol=FLOAT32
        )


def test_a_plane_comes_through_unchanged(device: str) -> None:
    depth = np.full((30, 26), 0.5)
    cells, points = run_crop(device, depth, crop_row(4.0, 5.0, 1.0), WIDE_GATE, 16)
    np.testing.assert_allclose(cells[0], 0.5, atol=FLOAT32)
    v, u = np.mgrid[5:21, 4:20]
    expected = np.stack([(u - 12.5) / 30 * 0.5, (v - 14) / 31 * 0.5, np.full(u.shape, 0.5)], -1)
    np.testing.assert_allclose(points[0], expected, atol=FLOAT32)


def test_points_lie_on_the_rays_of_the_crop_camera(device: str) -> None:
    # With whole pixels per cell the crop is an exact camera of its own.
    rng = np.random.default_rng(1)
    depth = 0.5 + 0.002 * rng.random((40, 40))
    crop = crop_row(2.0, 3.0, 2.0)
    cells, points = run_crop(device, depth, crop, WIDE_GATE, 16)
    row, column = np.mgrid[:16, :16]
    z = cells[0]
    np.testing.assert_allclose(points[0, ..., 0] / z * crop[0] + crop[2], column, atol=1e-4)
    np.testing.assert_allclose(points[0, ..., 1] / z * crop[1] + crop[3], row, atol=1e-4)


def test_nothing_measured_is_background(device: str) -> None:
    for nothing in (0.0, -1.0, np.nan):
        depth = np.full((30, 26), nothing)
        cells, _ = run_crop(device, depth, crop_row(4.0, 5.0, 1.0), WIDE_GATE, 16)
        np.testing.assert_array_equal(cells, 0.0)


def test_outside_the_image_is_unknown(device: str) -> None:
    depth = np.full((30, 26), 0.5)
    cells, points = run_crop(device, depth, crop_row(-4.0, -6.0, 1.0), WIDE_GATE, 16)
    assert np.isinf(cells[0, :6]).all() and np.isinf(cells[0, :, :4]).all()
    assert np.isfinite(cells[0, 6:, 4:]).all()
    assert np.isfinite(points).all()
    far, _ = run_crop(device, depth, crop_row(1e6, -1e6, 1.0), WIDE_GATE, 16)
    assert np.isinf(far).all()


def test_what_lies_behind_the_hand_is_background_and_before_it_unknown(device: str) -> None:
    gate = np.array([0.0, 0.0, 0.5, 0.15])
    behind, _ = run_crop(device, np.full((30, 26), 0.9), crop_row(5, 6, 1.0), gate, 16)
    before, _ = run_crop(device, np.full((30, 26), 0.3), crop_row(5, 6, 1.0), gate, 16)
    np.testing.assert_array_equal(behind, 0.0)
    assert np.isinf(before).all()


def test_a_stray_pixel_is_unknown(device: str) -> None:
    depth = np.full((30, 26), 0.5)
    depth[12, 13] = 0.4
    cells, _ = run_crop(device, depth, crop_row(4.0, 5.0, 1.0), WIDE_GATE, 16)
    assert np.isinf(cells[0, 7, 9])
    assert np.isfinite(np.delete(cells[0].ravel(), 7 * 16 + 9)).all()
    # Its neighbours do not take part of its depth.
    np.testing.assert_allclose(np.delete(cells[0].ravel(), 7 * 16 + 9), 0.5, atol=FLOAT32)


def test_a_hole_in_a_surface_is_closed(device: str) -> None:
    depth = np.full((30, 26), 0.5)
    depth[12, 13] = 0.0
    cells, points = run_crop(device, depth, crop_row(4.0, 5.0, 1.0), WIDE_GATE, 16)
    np.testing.assert_allclose(cells, 0.5, atol=FLOAT32)
    assert points[0, 7, 9, 2] == pytest.approx(0.5)


@settings(
    deadline=None,
    max_examples=30,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.integers(0, 2**32 - 1),
    value=st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30, 0.0]),
    x0=st.sampled_from([0.0, -1e9, 1e9, np.nan, np.inf]),
)
def test_no_depth_image_gives_nan(device: str, seed: int, value: float, x0: float) -> None:
    rng = np.random.default_rng(seed)
    depth = patchwork(rng, 29, 26)
    depth[rng.random(depth.shape) < rng.random()] = value
    cells, _ = run_crop(device, depth, crop_row(x0, 2.0, 1.0), WIDE_GATE, 16)
    assert not np.isnan(cells).any() and (cells >= 0).all()


def random_cells(rng: np.random.Generator, count: int, size: int, share: float) -> Float:
    cells = np.where(rng.random((count, size, size)) < share, 0.5, 0.0)
    cells[rng.random(cells.shape) < 0.05 * share] = np.inf
    return cells


@pytest.mark.parametrize("share", [0.0, 0.02, 0.2, 0.9, 1.0])
def test_both_halves_make_an_exact_distance_transform(
    device: str, share: float, rng: np.random.Generator
) -> None:
    size = 24
    cells = random_cells(rng, 3, size, share)
    nearest = poisoned(cells.shape, device, int)
    scan_columns(upload(cells, device), nearest=nearest)
    rows = download(nearest)
    for hand in range(3):
        vertical = np.where(rows[hand] < 0, -1, np.abs(rows[hand] - np.arange(size)[:, None]))
        np.testing.assert_array_equal(vertical, nearest_in_column(cells[hand]))
        # What is pointed at is no background.
        for row, column in np.argwhere(rows[hand] >= 0):
            assert cells[hand, rows[hand, row, column], column] > 0
        # The second half: the best column for every cell.
        squared = np.where(vertical < 0, np.inf, vertical.astype(float) ** 2)
        gap = (np.arange(size)[:, None] - np.arange(size)) ** 2
        combined = (squared[:, None, :] + gap[None]).min(-1)
        np.testing.assert_array_equal(combined, squared_distances(cells[hand]))


def run_normals(device: str, cells: Float, points: Float, reach: int, max_step: float) -> Float:
    normals = poisoned(cells.shape, device, wp.vec3)
    estimate_normals(
        upload(cells, device), upload(points, device, wp.vec3),
        reach=reach, max_step=max_step, normals=normals,
    )  # fmt: skip
    return download(normals)


def plane_points(normal: Float, size: int) -> tuple[Float, Float]:
    """Cells and points where the rays of a crop camera meet a plane through (0, 0, 0.5)."""
    row, column = np.mgrid[:size, :size]
    rays = np.stack([(column - size / 2) / 300, (row - size / 2) / 300, np.ones_like(row)], -1)
    points = rays * (0.5 * normal[2] / (rays @ normal))[..., None]
    return points[None, ..., 2], points[None]


@pytest.mark.parametrize("reach", [1, 2, 3])
@pytest.mark.parametrize(
    "normal", [(0, 0, -1), (0.5, 0, -0.8), (-0.3, 0.6, -0.6), (0.1, -0.7, -0.7)]
)
def test_the_normal_of_a_plane_is_exact(device: str, normal: tuple, reach: int) -> None:
    direction = np.array(normal, float) / np.linalg.norm(normal)
    cells, points = plane_points(direction, 20)
    normals = run_normals(device, cells, points, reach, 0.1)
    inside = slice(reach, -reach)
    # Differences of float32 points a millimetre apart.
    np.testing.assert_allclose(
        normals[0, inside, inside], np.broadcast_to(direction, (20 - 2 * reach,) * 2 + (3,)),
        atol=2e-3,
    )  # fmt: skip
    border = np.ones((20, 20), bool)
    border[inside, inside] = False
    np.testing.assert_array_equal(normals[0, border], 0.0)


def test_normals_do_not_bridge_a_depth_edge(device: str) -> None:
    cells, points = plane_points(np.array([0.0, 0.0, -1.0]), 20)
    points[:, :, 10:] *= 1.2
    cells = points[..., 2]
    normals = run_normals(device, cells, points, 1, SAME_SURFACE)
    np.testing.assert_allclose(normals[0, 1:-1, 1:-1, 2], -1.0, atol=1e-4)


@pytest.mark.parametrize("reach", [1, 2])
def test_normals_equal_the_oracle(device: str, reach: int, rng: np.random.Generator) -> None:
    cells, points = plane_points(np.array([0.2, 0.1, -0.97]), 18)
    cells, points = np.tile(cells, (2, 1, 1)), np.tile(points, (2, 1, 1, 1))
    scale = 1 + 0.004 * rng.standard_normal(cells.shape)
    scale[0, 5:9, 5:12] *= 1.1
    points = rounded(points * scale[..., None])
    cells = points[..., 2].copy()
    kind = rng.random(cells.shape)
    cells[kind < 0.1] = 0.0
    cells[(kind > 0.1) & (kind < 0.2)] = np.inf
    points[kind < 0.2] = 0.0
    normals = run_normals(device, cells, points, reach, SAME_SURFACE)
    for hand in range(2):
        expected = surface_normals(cells[hand], points[hand], reach=reach, max_step=SAME_SURFACE)
        np.testing.assert_allclose(normals[hand], expected, atol=2e-3)
        # No measurement, no normal.
        assert not normals[hand][kind[hand] < 0.2].any()


def test_a_sphere_shows_its_normals(device: str) -> None:
    row, column = np.mgrid[:40, :40]
    rays = np.stack([(column - 20) / 300, (row - 20) / 300, np.ones(row.shape)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre, radius = np.array([0.0, 0.0, 0.5]), 0.03
    along = rays @ centre
    inside = along**2 - (centre @ centre - radius**2)
    hit = inside > 0
    points = rays * (along - np.sqrt(np.maximum(inside, 0)))[..., None] * hit[..., None]
    normals = run_normals(device, points[None, ..., 2], points[None], 1, SAME_SURFACE)[0]
    outward = np.where(hit[..., None], (points - centre) / radius, 0.0)
    steep = -(outward * rays).sum(-1) > 0.5
    cosine = (normals * outward).sum(-1)[steep]
    # A curved surface of this size bends a few degrees between neighbours.
    assert cosine.min() > np.cos(np.radians(6))


def test_the_layout_of_crop_parameters_is_the_documented_one() -> None:
    row = crop_row(3.0, 4.0, 1.5)
    # Cell k lies at pixel x0 + step * k in both descriptions of the grid.
    for k, following in pairwise(range(5)):
        x = row[4] + row[6] * k
        assert (x - CAMERA[2]) / CAMERA[0] == pytest.approx((k - row[2]) / row[0])
        assert row[4] + row[6] * following - x == pytest.approx(1.5)
