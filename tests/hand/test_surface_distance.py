"""Distances from a surface against what is known of a sphere and a plane."""

import numpy as np
import trimesh

from handtrack.hand.surface_distance import surface_distance


def test_points_over_a_plane_are_as_far_as_they_are_high() -> None:
    grid = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide().subdivide().subdivide()
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.full(50, 0.6)])
    found = surface_distance(points, grid.vertices, grid.faces)
    np.testing.assert_allclose(found, 0.1, atol=1e-12)


def test_vertices_no_triangle_uses_are_no_surface() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0.5]])
    found = surface_distance([[0.2, 0.2, 0.5]], vertices, [[0, 1, 2]])
    np.testing.assert_allclose(found, 0.5)


def test_points_of_the_surface_lie_on_it() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    points, _ = trimesh.sample.sample_surface(ball, 300, seed=1)
    assert surface_distance(points, ball.vertices, ball.faces).max() < 1e-12


def test_distances_from_a_plane_of_triangles(rng: np.random.Generator) -> None:
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(36)], 1)
    corner = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + 6], 1),
        np.stack([corner + 1, corner + 7, corner + 6], 1),
    ])  # fmt: skip
    points = rng.uniform([0.5, 0.5, -2.0], [4.5, 4.5, 2.0], (50, 3))
    found = surface_distance(points, vertices, faces)
    np.testing.assert_allclose(found, np.abs(points[:, 2]), atol=1e-12)
    beyond = surface_distance(np.array([[8.0, 5.0, 4.0]]), vertices, faces)
    np.testing.assert_allclose(beyond, 5.0)
