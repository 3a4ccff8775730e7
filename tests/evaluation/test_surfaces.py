"""Distances between surfaces, against known ones."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.evaluation.surfaces import distances_to_surface, rest_surface_distance
from oracles.scenes import shaped_hand


def test_distances_from_a_plane_of_triangles(rng) -> None:
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(36)], 1)
    corner = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + 6], 1),
        np.stack([corner + 1, corner + 7, corner + 6], 1),
    ])  # fmt: skip
    points = rng.uniform([0.5, 0.5, -2.0], [4.5, 4.5, 2.0], (50, 3))
    found = distances_to_surface(points, vertices, faces)
    np.testing.assert_allclose(found, np.abs(points[:, 2]), atol=1e-12)
    beyond = distances_to_surface(np.array([[8.0, 5.0, 4.0]]), vertices, faces)
    np.testing.assert_allclose(beyond, 5.0)


def test_a_hand_is_no_distance_from_itself_and_some_from_a_larger_one() -> None:
    hand = shaped_hand("right", 2)
    assert rest_surface_distance(hand, hand) == pytest.approx(0.0, abs=1e-9)
    near, far = (rest_surface_distance(hand, hand.scaled(s)) for s in (1.02, 1.04))
    assert 0.0003 < near < far < 0.003
    assert far == pytest.approx(rest_surface_distance(hand.scaled(1.04), hand))
