"""Depth rendering against ray casting, and what a z-buffer must never do."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtrack.kernels.render import EMPTY, key_item_numpy, render_keys, unpack_depth
from oracles.device_arrays import download, poisoned, upload
from oracles.raycast import cast_rays
from oracles.scenes import SMALL_CAMERA

Float = NDArray[np.float64]

DEPTH = 2e-6
"""Float32 depth of a triangle seen at an angle, at half a metre [m]."""
SUBPIXEL = 1e-3
"""How near to an outline rounding may decide whether a pixel is covered [pixels]."""

FORWARD = np.array([0.0, 0.0, 1.0])
INTRINSICS = np.array(
    [SMALL_CAMERA.fx, SMALL_CAMERA.fy, SMALL_CAMERA.cx, SMALL_CAMERA.cy, 0.0, 0.0]
)


def draw(
    device: str,
    vertices: Float,
    faces: NDArray,
    *,
    cameras: Float = INTRINSICS,
    row_hand: tuple[int, ...] | None = None,
    shape: tuple[int, int] = SMALL_CAMERA.shape,
    **options: float,
) -> tuple[Float, NDArray[np.int64]]:
    """Depth, 0 = nothing drawn, and triangle, -1 for none, of every row."""
    vertices = vertices.reshape(-1, *vertices.shape[-2:])
    row_hand = row_hand or (0,) * len(vertices)
    keys = poisoned((len(vertices), *shape), device, wp.int64)
    depth = poisoned((len(vertices), *shape), device)
    render_keys(
        upload(faces, device), upload(np.array(row_hand), device),
        upload(np.atleast_2d(cameras), device), upload(vertices, device, wp.vec3), keys=keys,
        **options,
    )  # fmt: skip
    unpack_depth(keys, depth=depth)
    host = keys.numpy()
    drawn = host != EMPTY
    z = download(depth)
    np.testing.assert_array_equal(z > 0, drawn)
    return z, np.where(drawn, key_item_numpy(host), -1)


def pixel_rays(pixels: Float, camera: Float = INTRINSICS) -> Float:
    """Directions with z = 1 through pixels (u, v)."""
    return np.column_stack([(pixels - camera[2:4]) / camera[:2], np.ones(len(pixels))])


@pytest.mark.parametrize("side", ["right", "left"])
def test_hand_depth_equals_ray_casting(make_posed, device, rng, side) -> None:
    posed = make_posed(device, side=side, seed=51, bend=0.8, distance=0.4)
    vertices, faces = download(posed.vertices), posed.hands[0].faces
    depth, items = draw(device, vertices, faces)
    for row in range(posed.nrow):
        drawn = np.argwhere(depth[row] > 0)[:, ::-1]
        low, high = np.maximum(drawn.min(0) - 3, 0), np.minimum(drawn.max(0) + 3, [159, 119])
        pixels = rng.integers(low, high + 1, (350, 2))
        expected, hit = cast_rays(vertices[row], faces, pixel_rays(pixels))
        found = depth[row][pixels[:, 1], pixels[:, 0]]
        item = items[row][pixels[:, 1], pixels[:, 0]]
        covered = np.isfinite(expected)
        assert 60 < covered.sum() < 340
        # Where a ray a thousandth of a pixel beside hits something else, either answer is right.
        sure = np.ones(len(pixels), bool)
        for shift in SUBPIXEL * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
            beside, _ = cast_rays(vertices[row], faces, pixel_rays(pixels + shift))
            same = np.isfinite(beside) == covered
            near = (
                np.abs(np.where(covered, expected, 0) - np.where(same & covered, beside, 0)) < 1e-4
            )
            sure &= same & near
        assert sure.mean() > 0.95
        np.testing.assert_array_equal((found > 0)[sure], covered[sure])
        check = sure & covered
        # Steep triangles: a rounding of the pixel by 1e-5 moves the hit by its slope.
        np.testing.assert_allclose(found[check], expected[check], atol=10 * DEPTH)
        assert np.median(np.abs(found[check] - expected[check])) < DEPTH
        assert all(int(item[k]) in hit[k] for k in np.flatnonzero(check))


def test_nothing_is_drawn_of_an_empty_scene(device: str) -> None:
    behind = np.array([[0.0, 0, -1], [0.1, 0, -1], [0, 0.1, -1]])
    depth, items = draw(device, behind, np.array([[0, 2, 1], [0, 1, 2]]))
    assert not depth.any() and (items == -1).all()


def test_only_the_outside_of_a_face_is_seen(device: str) -> None:
    triangle = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.0, 0.1, 0.5]])
    # Seen from the camera, outward counter-clockwise: normal towards the camera, -z.
    normal = np.cross(triangle[2] - triangle[0], triangle[1] - triangle[0])
    assert normal[2] < 0
    assert draw(device, triangle, np.array([[0, 2, 1]]))[0].any()
    assert not draw(device, triangle, np.array([[0, 1, 2]]))[0].any()


def test_depth_is_z_and_not_ray_length(device: str) -> None:
    square = np.array([[-1.0, -1, 0.5], [1, -1, 0.5], [1, 1, 0.5], [-1, 1, 0.5]])
    depth, _ = draw(device, square, np.array([[0, 2, 1], [0, 3, 2]]))
    np.testing.assert_allclose(depth, 0.5, atol=1e-6)


def test_a_slanted_plane_has_its_depth_at_every_pixel_centre(device: str) -> None:
    normal = np.array([0.3, -0.2, -0.8])
    corners = np.array([[-0.6, -0.5], [0.6, -0.5], [0.6, 0.5], [-0.6, 0.5]])
    z = 0.5 - corners @ normal[:2] / normal[2]
    square = np.column_stack([corners, z])
    assert (z > 0.05).all()
    depth, _ = draw(device, square, np.array([[0, 2, 1], [0, 3, 2]]))
    v, u = np.mgrid[: SMALL_CAMERA.height, : SMALL_CAMERA.width]
    rays = pixel_rays(np.stack([u, v], -1).reshape(-1, 2).astype(float))
    expected = (0.5 * normal[2] / (rays @ normal)).reshape(depth.shape[1:])
    drawn = depth[0] > 0
    assert drawn.mean() > 0.5
    np.testing.assert_allclose(depth[0][drawn], expected[drawn], rtol=3e-6)


def test_the_nearest_of_two_surfaces_is_kept_whatever_the_order(device: str) -> None:
    square = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    both = np.concatenate([square + 0.6 * FORWARD, square + 0.5 * FORWARD])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]])
    for order in (faces, faces[::-1]):
        depth, items = draw(device, both, order)
        middle = depth[0, 60, 80], items[0, 60, 80]
        assert middle[0] == pytest.approx(0.5, abs=1e-6)
        assert (order[middle[1]] >= 4).all()


def test_of_equally_near_triangles_the_first_is_kept(device: str) -> None:
    triangle = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.0, 0.1, 0.5]])
    faces = np.tile([[0, 2, 1]], (5, 1))
    _, items = draw(device, triangle, faces)
    assert set(np.unique(items)) == {-1, 0}


@settings(
    deadline=None,
    max_examples=25,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.integers(0, 2**32 - 1), detail=st.integers(0, 4), aligned=st.booleans(),
    radius=st.sampled_from([0.03, 0.1, 0.2]),
)  # fmt: skip
def test_a_closed_mesh_has_no_cracks(
    device: str, seed: int, detail: int, aligned: bool, radius: float
) -> None:
    rng = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions=detail)
    centre = np.array([*rng.uniform(-0.05, 0.05, 2), 0.5])
    vertices = sphere.vertices * radius
    camera = INTRINSICS.copy()
    if aligned:
        # Edges that run exactly through pixel centres are the hard case.
        vertices, centre = np.round(vertices * 240) / 240, np.array([0.0, 0.0, 0.5])
        camera[:4] = 120.0, 120.0, 80.0, 60.0
    depth, _ = draw(device, vertices + centre, sphere.faces, cameras=camera)
    drawn = depth[0] > 0
    assert drawn.any()
    # The picture of a convex body is convex, so a pixel with covered ones on all four sides lies
    # inside; at the outline itself, one side at least is free.
    inside = np.ones_like(drawn)
    for axis in (0, 1):
        inside &= np.logical_or.accumulate(drawn, axis)
        inside &= np.flip(np.logical_or.accumulate(np.flip(drawn, axis), axis), axis)
    cracks = np.argwhere(inside & ~drawn)
    assert not len(cracks), f"{len(cracks)} of {inside.sum()} pixels, such as {cracks[0]}"


def test_rows_use_their_own_camera_and_vertices(make_posed, device) -> None:
    posed = make_posed(device, seed=52)
    cameras = np.stack([INTRINSICS, INTRINSICS * [0.5, 0.5, 0.5, 0.5, 1, 1]])
    vertices, faces = download(posed.vertices), posed.hands[0].faces
    depth, items = draw(device, vertices, faces, cameras=cameras, row_hand=(1, 0, 1))
    for row, hand in enumerate((1, 0, 1)):
        alone, item = draw(device, vertices[row], faces, cameras=cameras[hand])
        np.testing.assert_array_equal(depth[row], alone[0])
        np.testing.assert_array_equal(items[row], item[0])
    assert (depth[1] > 0).sum() > 3 * (depth[0] > 0).sum()


def test_triangles_that_come_too_near_are_dropped(device: str) -> None:
    triangle = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.0, 0.1, 0.015]])
    faces = np.array([[0, 2, 1]])
    assert not draw(device, triangle, faces)[0].any()
    assert not draw(device, triangle + 0.1 * FORWARD, faces, near=0.2)[0].any()
    assert draw(device, triangle + 0.1 * FORWARD, faces, near=0.05)[0].any()


def test_drawing_without_clearing_adds_to_the_picture(device: str) -> None:
    square = np.array([[-0.1, -0.1, 0.5], [0.1, -0.1, 0.5], [0.1, 0.1, 0.5], [-0.1, 0.1, 0.5]])
    faces = upload(np.array([[0, 2, 1], [0, 3, 2]]), device)
    rows, cameras = upload(np.array([0]), device), upload(INTRINSICS[None], device)
    keys = poisoned((1, *SMALL_CAMERA.shape), device, wp.int64)
    depth = poisoned((1, *SMALL_CAMERA.shape), device)
    for shift, clear in (([0.05, 0, 0.1], True), ([0, 0, 0], False), ([-0.05, 0, 0.2], False)):
        render_keys(
            faces, rows, cameras, upload((square + shift)[None], device, wp.vec3), keys=keys,
            clear=clear,
        )  # fmt: skip
    unpack_depth(keys, depth=depth)
    found = set(np.round(np.unique(download(depth)), 4))
    assert found == {0.0, 0.5, 0.6, 0.7}
    assert download(depth)[0, 60, 80] == pytest.approx(0.5)


@settings(
    deadline=None,
    max_examples=30,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32 - 1))
def test_garbage_vertices_give_no_nan_and_spare_other_rows(device: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=1)
    good = mesh.vertices * 0.1 + [0, 0, 0.5]
    bad = good.copy()
    values = [np.nan, np.inf, -np.inf, 1e38, -1e38, 1e10, 1e-30, 0.0]
    where = rng.random(bad.shape) < 0.2
    bad[where] = rng.choice(values, where.sum())
    depth, items = draw(device, np.stack([good, bad, good]), mesh.faces)
    assert np.isfinite(depth).all() and (depth >= 0).all()
    assert items.max() < len(mesh.faces)
    np.testing.assert_array_equal(depth[0], draw(device, good, mesh.faces)[0][0])
    np.testing.assert_array_equal(depth[2], depth[0])
