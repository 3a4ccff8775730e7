"""The cup's mesh, and rendering a mesh against ray casting."""

from __future__ import annotations

import numpy as np

from handtrack.camera.camera import Camera
from handtrack.synthesis.things import MeshRenderer, cup_mesh
from handtrack.transforms import rotvec_to_matrix
from oracles.raycast import cast_rays

CAMERA = Camera(width=80, height=60, fx=62.0, fy=62.0, cx=39.5, cy=29.5)


def test_the_cup_is_open_and_has_a_handle() -> None:
    cup = cup_mesh(radius=0.04, height=0.09, wall=0.004)
    low, high = cup.bounds
    assert np.allclose(low[[0, 2]], -0.04, atol=1e-3) and np.allclose(high[2], 0.04, atol=1e-3)
    assert np.allclose([low[1], high[1]], [-0.045, 0.045], atol=1e-6)
    assert 0.06 < high[0] < 0.08, "the handle"
    # Rays down into the opening reach the bottom, rays from below do not come in.
    points, faces = np.asarray(cup.vertices), np.asarray(cup.faces)
    x, y, z = points.T
    # A hair beside the axis, where triangles meet.
    ray = np.array([[0.003, 0.004, 1.0]])
    inside, _ = cast_rays(np.stack([x, -z, y + 0.2], axis=1), faces, ray)
    outside, _ = cast_rays(np.stack([x, z, 0.2 - y], axis=1), faces, ray)
    np.testing.assert_allclose(inside, 0.2 + 0.045 - 0.004, atol=1e-6)
    np.testing.assert_allclose(outside, 0.2 - 0.045, atol=1e-6)


def test_a_mesh_is_rendered_where_rays_meet_it(device: str) -> None:
    cup = cup_mesh()
    rotation, place = rotvec_to_matrix(np.array([0.6, 0.4, -0.2])), np.array([0.01, -0.02, 0.25])
    renderer = MeshRenderer(cup, CAMERA, device=device)
    depth = renderer.render(rotation, place)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float), np.ones(v.size))
    points = np.asarray(cup.vertices) @ rotation.T + place
    true, _ = cast_rays(points, np.asarray(cup.faces), rays)
    true = np.where(np.isfinite(true), true, 0.0).reshape(depth.shape)
    both = (depth > 0) & (true > 0)
    assert both.sum() > 300 and ((depth > 0) != (true > 0)).sum() <= 3
    assert np.abs(depth - true)[both].max() < 1e-3
    # The next image holds nothing of this one.
    assert not renderer.render(rotation, place - np.array([0.0, 0.0, 5.0])).any()
