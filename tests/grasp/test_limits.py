"""What a hand cannot grasp is told with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.limits import (
    check_task,
    most_carried,
    narrowest,
    reason_against,
    widest_grasp,
)
from handtrack.objects import shapes
from handtrack.objects.library import TEST_OBJECTS, load_object
from handtrack.objects.rigid_object import RigidObject
from oracles.scenes import shaped_hand

DOWN = np.array([0.0, 0.0, -9.81])


def standing(body: RigidObject, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return np.concatenate([np.array([0, 0, body.rest_height]) + shift, [1.0, 0, 0, 0]])


@pytest.mark.parametrize("name", TEST_OBJECTS)
def test_all_test_objects_can_be_asked_for(name: str) -> None:
    body = load_object(name)
    check_task(
        shaped_hand(), body, place=standing(body), target=standing(body, (0.2, 0.1, 0.15)),
        start=None,
    )  # fmt: skip


def test_a_target_or_a_place_inside_the_table_is_refused() -> None:
    body = load_object("cube_50")
    good, sunk = standing(body), standing(body, (0.2, 0.0, -0.012))
    with pytest.raises(InputError, match="cube_50 is to be brought 12 mm inside the table"):
        check_task(shaped_hand(), body, place=good, target=sunk, start=None)
    with pytest.raises(InputError, match="cube_50 starts 12 mm inside the table"):
        check_task(shaped_hand(), body, place=sunk, target=good, start=None)
    # Lying on its edge it would need more height.
    edge = good.copy()
    edge[3:] = [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]
    with pytest.raises(InputError, match="10 mm inside the table"):
        check_task(shaped_hand(), body, place=good, target=edge, start=None)


def test_what_is_out_of_reach_is_refused() -> None:
    body, hand = load_object("cube_50"), shaped_hand()
    here = standing(body)
    with pytest.raises(InputError, match=r"target is 3\.00 m from cube_50: out of reach"):
        check_task(hand, body, place=here, target=standing(body, (3.0, 0, 0)), start=None)
    start = np.zeros(28)
    start[:4] = 0.0, -2.0, 0.3, 1.0
    with pytest.raises(InputError, match="from the hand: out of reach"):
        check_task(hand, body, place=here, target=here, start=start)


def test_a_solid_wider_than_the_hand_is_refused_but_not_a_long_one() -> None:
    hand = shaped_hand()
    wide = RigidObject.of_shape(shapes.box(0.25, 0.25, 0.25), name="crate", mass=0.5)
    long = RigidObject.of_shape(shapes.box(0.25, 0.25, 0.05), name="book", mass=0.5)
    with pytest.raises(InputError, match=r"crate is too big: 250 mm.*grasps 1\d\d mm at most"):
        check_task(hand, wide, place=standing(wide), target=standing(wide), start=None)
    check_task(hand, long, place=standing(long), target=standing(long), start=None)
    assert widest_grasp(hand.scaled(1.2)) == pytest.approx(1.2 * widest_grasp(hand))


def test_least_width_of_bodies_that_lie_aslant() -> None:
    turn = shapes.moved(shapes.box(0.1, 0.2, 0.05), (0, 0, 0), turn=(0.4, 0.8, -0.3))
    assert narrowest(np.array(turn.mesh.vertices)) == pytest.approx(0.05, rel=1e-6)
    assert narrowest(load_object("sphere_75").vertices) == pytest.approx(0.075, rel=0.01)


def test_the_largest_mass_is_where_the_fingers_strength_ends() -> None:
    points = np.array([[0.02, 0, 0], [-0.02, 0, 0]])
    normals = points / 0.02
    # Two fingers of 20 N with friction 0.5 carry 20 N, less where the pyramid's edges lie badly.
    most = most_carried(points, normals, friction=0.5, gravity=DOWN)
    assert 20.0 / 9.81 / np.sqrt(2) * 0.98 <= most <= 20.0 / 9.81
    assert most_carried(points[:1], normals[:1], friction=0.5, gravity=DOWN) == 0.0


def test_the_reason_names_weight_distance_or_contacts() -> None:
    body = load_object("cube_50")
    points = np.array([[0.025, 0, 0], [-0.025, 0, 0]])
    normals = points / 0.025

    def reason(normals: np.ndarray, gaps: list[float]) -> str:
        return reason_against(
            body, points, normals, np.array(gaps), friction=0.5, gravity=DOWN
        )  # fmt: skip

    assert "too heavy" in reason(normals, [0.0, 0.001])
    assert "stays 23 mm from it" in reason(normals, [0.0, -0.023])
    assert "press against each other" in reason(np.array([[1.0, 0, 0], [0, 0, 1.0]]), [0.0, 0.0])
