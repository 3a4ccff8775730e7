"""Other things about an object: how near the hand comes, and grasps that leave them room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.clearance import clearance_points
from handtrack.grasp.closing import ClosingConfig
from handtrack.grasp.obstacles import Obstacle, room_beside
from handtrack.grasp.sequence import waiting_pose
from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box, sphere

LEVEL = (1.0, 0.0, 0.0, 0.0)


def obstacle(shape, x: float, y: float, z: float) -> Obstacle:
    body = RigidObject.of_shape(shape, name="thing", mass=0.1)
    place = np.array([x, y, z, *LEVEL])
    return Obstacle(distances=DistanceField.of(body, device="cpu"), place=place)


def test_room_is_the_least_distance_of_the_skin_from_any_obstacle() -> None:
    hand = HandModel.load().shaped()
    skin = clearance_points(hand)
    pose = np.zeros((2, 28))
    pose[:, 3], pose[:, 7:], pose[1, :3] = 1.0, hand.rest_angles, (0.0, 0.0, 0.1)
    assert np.isinf(room_beside(hand, skin, pose, [])).all()
    tip = keypoints(hand, pose[0])[12]
    ball, far = obstacle(sphere(0.04), *tip), obstacle(sphere(0.04), 0.0, 0.0, 3.0)
    points = skin.place(hand, pose)
    expected = np.linalg.norm(points - tip, axis=2).min(1) - 0.02
    found = room_beside(hand, skin, pose, [far, ball])
    np.testing.assert_allclose(found, expected, atol=1.5e-3)
    assert found[0] < -0.005  # the fingertip is inside
    # The mirror image is as far from the mirrored hand.
    left = HandModel.load().shaped(side="left")
    mirrored = room_beside(left, clearance_points(left), mirror_pose(pose), [ball.mirrored()])
    np.testing.assert_allclose(mirrored, found, atol=3e-3)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_grasp_leaves_room_to_what_stands_at_the_target(side: str) -> None:
    hand = HandModel.load().shaped(side=side)
    closing = ClosingConfig()
    planner = GraspSynthesizer(hand, config=SynthesisConfig(closing=closing), device="cpu")
    cube = load_object("cube_50")
    start = np.array([0.0, 0.0, cube.rest_height, *LEVEL])
    target = np.array([0.3, 0.0, cube.rest_height + 0.001, *LEVEL])
    # 15 mm behind it, seen from the hand: no room for a finger there.
    walls = [obstacle(box(0.03, 0.2, 0.06), 0.355, 0.0, 0.03)]
    ask = {"start": waiting_pose(planner, start), "place": start, "target": target}
    skin = clearance_points(hand)
    rooms = {}
    for name, obstacles in (("blind", []), ("careful", walls)):
        plans = [planner.plan(cube, **ask, obstacles=obstacles, seed=seed) for seed in range(4)]
        ends = np.array([plan.hand_poses[-1] for plan in plans])
        rooms[name] = room_beside(hand, skin, ends, walls)
    assert (rooms["careful"] > 0.4 * closing.objective.clearance).all()
    assert rooms["blind"].min() < 0.0


def test_a_place_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="place has shape"):
        replace(obstacle(sphere(0.04), 0.0, 0.0, 0.0), place=np.zeros(3))
