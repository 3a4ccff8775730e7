"""Distances from a surface against what is known of a sphere and a plane."""

import numpy as np
import trimesh

from handtrack.hand.learning.surface_distance import surface_distance


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
