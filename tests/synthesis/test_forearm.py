"""The forearm: closed, outward, from the wrist to the elbow, whichever way the wrist bends."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from handtrack.synthesis.forearm import (
    GROWTH,
    RINGS,
    SEGMENTS,
    forearm_faces,
    forearm_vertices,
    wrist_section,
)
from handtrack.transforms import rotvec_to_matrix
from oracles.scenes import shaped_hand


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("bend", [(0.0, 0.0), (0.9, 0.0), (-0.9, 0.0), (0.0, 0.5), (0.6, -0.4)])
def test_the_forearm_is_a_closed_tube_to_the_elbow(side: str, bend: tuple[float, float]) -> None:
    hand = shaped_hand(side)
    rotation = rotvec_to_matrix([0.3, -0.8, 0.5])
    origin = np.array([0.05, -0.02, 0.5])
    away = rotvec_to_matrix([0.0, bend[1], bend[0]]) @ [-0.25, 0.0, 0.0]
    elbow = origin + rotation @ away
    vertices = forearm_vertices(hand, rotation, origin, elbow)
    assert vertices.shape == (RINGS * SEGMENTS, 3)
    mesh = trimesh.Trimesh(vertices, forearm_faces(0), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0, "triangles face outward"
    first, last = vertices[:SEGMENTS], vertices[-SEGMENTS:]
    middle, half = wrist_section(hand)
    assert np.linalg.norm(first.mean(0) - origin) < 0.02 + np.linalg.norm(middle)
    assert np.linalg.norm(last.mean(0) - elbow) < 0.02
    # The muscles are thicker than the wrist, but not by more than they may.
    widths = [np.linalg.norm(ring - ring.mean(0), axis=1).max() for ring in (first, last)]
    assert half.max() * 0.99 < widths[0] < half.max() * 1.01
    assert 1.2 < widths[1] / widths[0] < 1.2 * GROWTH


def test_the_wrist_of_a_left_hand_mirrors_that_of_a_right_one() -> None:
    (right, half), (left, other) = wrist_section(shaped_hand()), wrist_section(shaped_hand("left"))
    np.testing.assert_allclose(left, right * [1, -1])
    np.testing.assert_allclose(half, other)
    assert 0.01 < half[0] < half[1] < 0.04  # metres; a wrist is wider than thick


def test_faces_count_from_the_first_vertex() -> None:
    np.testing.assert_array_equal(forearm_faces(100), forearm_faces(0) + 100)
    assert forearm_faces(0).max() == RINGS * SEGMENTS - 1
