"""Viewpoints: the whole sphere, the whole range of distances, the whole hand in view."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import HandModel
from handtrack.synthesis.sequence import CAMERAS
from handtrack.synthesis.viewpoints import (
    FOREARM,
    NEAREST,
    place_in_view,
    random_elbow,
    random_rotation,
)

HAND = HandModel.load().shaped()
FLAT = keypoints(HAND, np.concatenate([[0, 0, 0, 1, 0, 0, 0], np.zeros(21)]))


def test_directions_and_rolls_are_uniform() -> None:
    rng = np.random.default_rng(0)
    turns = np.array([random_rotation(rng) for _ in range(4000)])
    assert np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() < 1e-12
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    for axis in range(3):
        directions = turns[:, :, axis]
        # On a uniform sphere every coordinate is uniform from -1 to 1 (Archimedes).
        for coordinate in directions.T:
            counts, _ = np.histogram(coordinate, bins=10, range=(-1, 1))
            assert ((counts - 400) ** 2 / 400).sum() < 30  # chi square, 9 degrees: 1 in 2000
    # Roll about the palm's normal, given its direction.
    normal, finger = turns[:, :, 1], turns[:, :, 0]
    side = np.cross(normal, [0.0, 0.0, 1.0])
    up = np.cross(side, normal)
    roll = np.arctan2((finger * side).sum(1), (finger * up).sum(1))
    counts, _ = np.histogram(roll, bins=10, range=(-np.pi, np.pi))
    assert ((counts - 400) ** 2 / 400).sum() < 30


@pytest.mark.parametrize("name", CAMERAS)
def test_the_hand_is_in_view_over_the_whole_range(name: str) -> None:
    camera, rng = CAMERAS[name], np.random.default_rng(1)
    depths, places = [], []
    for _ in range(400):
        turn = random_rotation(rng)
        points, elbow = FLAT @ turn.T, turn @ random_elbow(rng)
        shift = place_in_view(points, elbow, camera, rng, distance=(0.2, 0.9))
        pixels = camera.project(points + shift)
        assert (pixels > -0.5).all() and (pixels < np.array(camera.shape[::-1]) - 0.5).all()
        assert (points + shift)[:, 2].min() > NEAREST - 1e-9
        assert (elbow + shift)[2] > NEAREST - 1e-9
        depths.append(palm_centre(points + shift)[2])
        places.append(camera.project(palm_centre(points + shift)) / camera.shape[::-1])
    assert 0.2 <= min(depths) < 0.3 and 0.85 < max(depths) <= 0.9
    assert np.histogram(depths, bins=4, range=(0.2, 0.9))[0].min() > 40
    # Not only in the middle of the image.
    assert (np.ptp(places, axis=0) > 0.6).all()
    assert np.abs(np.mean(places, axis=0) - 0.5).max() < 0.06


def test_a_range_of_one_distance_is_kept_where_the_hand_fits() -> None:
    camera, rng = CAMERAS["creative"], np.random.default_rng(2)
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # palm to the camera
    points, elbow = FLAT @ turn.T, turn @ [-0.25, 0, 0]
    shift = place_in_view(points, elbow, camera, rng, distance=(0.5, 0.5))
    assert palm_centre(points + shift)[2] == pytest.approx(0.5)


def test_a_view_that_is_too_narrow_is_told() -> None:
    camera = Camera(width=64, height=64, fx=640.0, fy=640.0, cx=31.5, cy=31.5)
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    with pytest.raises(InputError, match=r"fits into the image of 64x64 from \d\.\d+ m"):
        place_in_view(
            FLAT @ turn.T, np.zeros(3), camera, np.random.default_rng(0), distance=(0.2, 0.9)
        )


def test_the_wrist_bends_within_its_range() -> None:
    rng = np.random.default_rng(3)
    elbows = np.array([random_elbow(rng) for _ in range(2000)])
    lengths = np.linalg.norm(elbows, axis=1)
    assert lengths.min() >= FOREARM[0] and lengths.max() <= FOREARM[1]
    bend = np.degrees(np.arctan2(elbows[:, 1], -elbows[:, 0]))
    assert 20 < bend.std() < 30 and np.abs(bend).max() <= 70.01 and abs(bend.mean()) < 3
