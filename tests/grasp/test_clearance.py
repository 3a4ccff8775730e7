"""Ways that keep clear of object and table."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.clearance import MARGIN, Surroundings, cleared
from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import matrix_to_quat

HAND = HandModel.load().shaped()
HALF = 0.04


def ball_field() -> DistanceField:
    """Distances of a ball of radius 40 mm, from its formula."""
    grid = np.arange(-0.1, 0.1001, 0.004)
    places = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1)
    values = np.linalg.norm(places, axis=-1) - HALF
    return DistanceField(values=values.astype(np.float32), origin=np.full(3, -0.1), spacing=0.004)


PLACE = np.array([0.0, 0.0, HALF, 1.0, 0.0, 0.0, 0.0])
AROUND = Surroundings(HAND, ball_field(), PLACE)


def flat_hand(place: list[float]) -> np.ndarray:
    """An open hand, palm down, fingers along x."""
    pose = np.zeros(28)
    pose[:3] = place
    # Palm frame: x along the fingers, y palmar, z radial.
    pose[3:7] = matrix_to_quat(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]))
    return pose


def way_of(first: list[float], last: list[float], count: int = 40) -> np.ndarray:
    share = np.linspace(0.0, 1.0, count)[:, None]
    start, end = flat_hand(first), flat_hand(last)
    return start + share * (end - start)


def test_room_is_the_least_distance_of_skin_to_object_and_table() -> None:
    high, low = flat_hand([0.0, 0.0, 0.3]), flat_hand([-0.5, 0.0, 0.06])
    room = AROUND.room(np.stack([high, low]))
    for pose, value in zip((high, low), room, strict=True):
        points = skin(HAND, pose)
        away = np.linalg.norm(points - PLACE[:3], axis=1) - HALF
        true = min(away.min(), points[:, 2].min())
        assert true - 0.002 < value < true + 0.006  # 250 points instead of 1690


def test_a_clear_way_is_left_as_it_is() -> None:
    way = way_of([-0.6, 0.0, 0.3], [-0.3, 0.0, 0.15])
    np.testing.assert_array_equal(cleared(way, AROUND), way)


def test_a_way_through_the_object_is_bent_clear_of_it_and_ends_stay() -> None:
    way = way_of([-0.10, -0.35, 0.08], [-0.10, 0.35, 0.08])
    assert AROUND.room(way).min() < -0.01
    bent = cleared(way, AROUND)
    assert AROUND.room(bent).min() >= MARGIN - 1e-5
    np.testing.assert_array_equal(bent[[0, -1]], way[[0, -1]])
    np.testing.assert_array_equal(bent[:, 3:], way[:, 3:])
    assert np.abs(np.diff(bent[:, :3], 2, axis=0)).max() < 0.005


def test_a_way_through_the_table_is_raised() -> None:
    way = way_of([-0.6, 0.0, 0.08], [-0.3, 0.0, 0.08])
    way[:, 2] -= 0.1 * np.sin(np.linspace(0.0, np.pi, len(way))) ** 2
    bent = cleared(way, AROUND)
    assert AROUND.room(way).min() < 0.0 < AROUND.room(bent).min()


def test_where_nothing_helps_the_clearest_way_is_taken() -> None:
    way = way_of([-0.10, 0.0, 0.02], [-0.10, 0.0, 0.02])
    assert AROUND.room(cleared(way, AROUND)).min() >= AROUND.room(way).min()


def test_away_points_from_the_object_to_the_palm() -> None:
    away = AROUND.away(flat_hand([-0.3, 0.0, 0.2]))
    assert away[0] < -0.9 and away[2] == 0.0


def test_a_bad_place_is_refused() -> None:
    with pytest.raises(InputError, match="place has shape"):
        Surroundings(HAND, ball_field(), np.zeros(3))
