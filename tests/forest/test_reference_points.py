"""Reference points: spread over the skin, tied to the nearest vertex (II.4.1)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from handtrack.forest.config import ForestConfig
from handtrack.forest.reference_points import (
    FINGER_BOX,
    NEAR_SHARE,
    NEAR_SPREAD,
    PALM_BOX,
    draw_points,
    spread_vertices,
)
from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.skeleton import BASE_BONES
from oracles.scenes import shaped_hand

Float = NDArray[np.float64]

PARTS = (-1, 0, 1, 4)
"""The palm, the thumb and two fingers."""

CONFIG = ForestConfig(points=500)


def open_vertices(part: int) -> Float:
    """Vertices of the open hand in the frame of a part [m]."""
    hand = shaped_hand()
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], hand.rest_angles])
    rotations, origins = bone_frames(hand, pose)
    bone = 0 if part < 0 else BASE_BONES[part]
    return (skin(hand, pose) - origins[bone]) @ rotations[bone]


def drawn(part: int, *, seed: int = 0, features: str = "shape-indexed") -> tuple[NDArray, Float]:
    config = ForestConfig(points=CONFIG.points, features=features)
    anchors = spread_vertices(shaped_hand())
    return draw_points(shaped_hand(), anchors, part, config, np.random.default_rng(seed))


def places(part: int, **options) -> Float:
    """Where points lie on the mean hand, in the part's frame [m]."""
    numbers, offsets = drawn(part, **options)
    vertices = open_vertices(part)[spread_vertices(shaped_hand())]
    return np.where(numbers[:, None] < 0, 0.0, vertices[numbers]) + offsets


@pytest.mark.parametrize("count", [2, 40, 320])
def test_vertices_are_spread_evenly_over_the_hand(count: int) -> None:
    hand = shaped_hand()
    chosen = spread_vertices(hand, count)
    assert len(set(chosen)) == count
    assert not hand.stub_vertices[chosen].any()
    points = open_vertices(-1)
    apart = cdist(points[chosen], points[chosen])[np.triu_indices(count, 1)].min()
    uncovered = cdist(points[~hand.stub_vertices], points[chosen]).min(axis=1).max()
    # None is farther from all of them than they are from each other.
    assert uncovered <= apart + 1e-9


def test_no_more_vertices_are_chosen_than_there_are() -> None:
    hand = shaped_hand()
    chosen = spread_vertices(hand, 10**6)
    assert sorted(chosen) == np.flatnonzero(~hand.stub_vertices).tolist()


@pytest.mark.parametrize("part", PARTS)
def test_points_hang_on_the_vertex_nearest_to_them(part: int) -> None:
    numbers, offsets = drawn(part)
    vertices = open_vertices(part)[spread_vertices(shaped_hand())]
    distance = np.linalg.norm(offsets, axis=1)
    nearest = cdist(vertices[numbers] + offsets, vertices).min(axis=1)
    np.testing.assert_allclose(distance, nearest, atol=1e-6)
    assert len(np.unique(numbers)) > 50


@pytest.mark.parametrize("part", PARTS)
def test_pose_indexed_points_are_the_same_points_on_the_frames_origin(part: int) -> None:
    numbers, offsets = drawn(part, features="pose-indexed")
    np.testing.assert_array_equal(numbers, -1)
    np.testing.assert_allclose(offsets, places(part), atol=1e-6)


@pytest.mark.parametrize("part", PARTS)
def test_most_points_lie_near_the_skin_and_all_near_the_box(part: int) -> None:
    points = places(part)
    low, high = PALM_BOX if part < 0 else FINGER_BOX
    reach = 6 * NEAR_SPREAD
    assert ((points > low - reach) & (points < high + reach)).all()
    distance = cdist(points, open_vertices(part)).min(axis=1)
    assert (distance < 4 * NEAR_SPREAD).mean() > NEAR_SHARE
    inside = ((points > low) & (points < high)).all(axis=1)
    assert inside.mean() > 0.7
    # The rest fills the box.
    far = points[distance > NEAR_SPREAD]
    assert (np.ptp(far, axis=0) > 0.8 * (high - low)).all()


def test_points_follow_from_the_random_numbers() -> None:
    np.testing.assert_array_equal(drawn(-1)[1], drawn(-1)[1])
    assert (drawn(-1)[1] != drawn(-1, seed=1)[1]).any(axis=1).mean() > 0.99
