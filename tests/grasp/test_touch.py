"""Set points that give way: what they hold still, and what they follow."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from handtrack.grasp.reference import Stage
from handtrack.grasp.touch import FOLLOW_TIME, MOST_SHIFT, SetPoints
from handtrack.hand.model import HandModel
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box
from handtrack.physics.scene import Scene
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

BLOCK = RigidObject.of_shape(box(0.05, 0.05, 0.05), name="block", mass=0.1)
THUMB, INDEX = 0, 1
INDEX_DOFS = slice(11, 15)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(HandModel.load().shaped(), [BLOCK])


def palm_of(rotvec: list[float], place: list[float]) -> np.ndarray:
    return np.concatenate([place, matrix_to_quat(rotvec_to_matrix(rotvec))])


def test_only_the_finger_that_touches_stops_while_closing(scene: Scene) -> None:
    points = SetPoints(scene, np.array([3, 6]))
    way = np.full(27, 0.1)
    for _ in range(200):
        points.settle(way, Stage.CLOSING, {INDEX})
    left = way.copy()
    points.shift(left)
    np.testing.assert_allclose(left[INDEX_DOFS], 0.0, atol=1e-5)
    np.testing.assert_array_equal(left[:11], way[:11])


def test_planned_fingers_settle_while_taking_hold_and_return_when_let_go(scene: Scene) -> None:
    points = SetPoints(scene, np.array([3, 6]))
    way = np.full(27, 0.1)
    for _ in range(200):
        points.settle(way, Stage.TAKING, set())
    assert np.abs(way + points.offset)[6:15].max() < 1e-5  # thumb and index finger
    np.testing.assert_array_equal(points.offset[15:], 0.0)
    for _ in range(1000):
        points.let_go()
    assert np.abs(points.offset).max() < 1e-5


def test_palm_goes_where_it_must_be_for_the_object_to_reach_its_goal(scene: Scene) -> None:
    points = SetPoints(scene, np.array([3, 6]))
    scene.set_hand(np.concatenate([palm_of([0.3, 0, 0], [0, 0, 0.3]), np.zeros(21)]))
    palm = palm_of([0.3, 0, 0], [0, 0, 0.3])
    thing = palm_of([0, 0, 0.1], [0.1, 0.01, 0.25])
    goal = palm_of([0, 0, 0.0], [0.1, 0.0, 0.25])
    for _ in range(3000):
        points.follow(palm, thing, palm, goal, steps=4)
    way = np.zeros(27)
    points.shift(way)
    # Moving the palm by this rigid motion takes the object with it to its goal.
    swing = rotvec_to_matrix([0, 0, -0.1])
    np.testing.assert_allclose(way[:3], goal[:3] + swing @ (palm[:3] - thing[:3]) - palm[:3])
    np.testing.assert_allclose(rotvec_to_matrix([0.3, 0, 0]) @ way[3:6], [0, 0, -0.1], atol=1e-9)


def test_palm_follows_slowly_and_not_after_a_lost_object(scene: Scene) -> None:
    points = SetPoints(scene, np.array([3]))
    palm = palm_of([0, 0, 0], [0, 0, 0.3])
    thing, far = palm_of([0, 0, 0], [0.1, 0, 0.3]), palm_of([0, 0, 0], [0.1, 0, -1.0])
    points.follow(palm, thing + np.eye(7)[1] * 0.01, palm, thing, steps=1)
    way = np.zeros(27)
    points.shift(way)
    np.testing.assert_allclose(way[1], -0.01 * 0.001 / FOLLOW_TIME)
    for _ in range(2000):
        points.follow(palm, far, palm, thing, steps=4)
    way = np.zeros(27)
    points.shift(way)
    assert np.linalg.norm(way[:3]) <= MOST_SHIFT + 1e-12
