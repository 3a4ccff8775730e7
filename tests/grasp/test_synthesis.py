"""Whole plans: phases that join, an object that is carried, errors in one line."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.closing import ClosingConfig
from handtrack.grasp.mirror import FLIP_POSE
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.swarm import SwarmConfig
from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig, in_world
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box
from handtrack.transforms import pose_difference, quat_to_matrix

QUICK = SynthesisConfig(
    closing=ClosingConfig(
        swarm=SwarmConfig(particles=48, groups=4, generations=12), candidates=8, attempts=2
    ),
    release=True,
)


@pytest.fixture(scope="module")
def planner() -> GraspSynthesizer:
    return GraspSynthesizer(config=QUICK, device="cpu")


@pytest.fixture(scope="module")
def plan(planner: GraspSynthesizer) -> GraspPlan:
    body = load_object("cube_50")
    place = np.array([0.3, -0.2, body.rest_height, 1.0, 0.0, 0.0, 0.0])
    target = np.array([0.5, -0.1, 0.2, np.cos(0.3), 0.0, 0.0, np.sin(0.3)])
    start = np.zeros(28)
    start[:3], start[3], start[7:] = [0.0, -0.4, 0.2], 1.0, planner.hand.rest_angles
    return planner.plan(body, grip="tripod", start=start, place=place, target=target, seed=1)


def test_a_plan_has_all_phases_and_brings_the_object_to_its_target(plan: GraspPlan) -> None:
    assert plan.grip == "tripod"
    assert plan.feasible
    assert list(dict.fromkeys(plan.phases.tolist())) == [
        "reaching", "closing", "manipulation", "releasing",
    ]  # fmt: skip
    np.testing.assert_allclose(plan.hand_poses[0, :3], [0.0, -0.4, 0.2], atol=0.01)
    np.testing.assert_allclose(plan.object_poses[0, :3], [0.3, -0.2, 0.025], atol=1e-9)
    np.testing.assert_allclose(plan.object_poses[-1, :3], [0.5, -0.1, 0.2], atol=1e-9)
    still = plan.of_phase("releasing")
    assert np.ptp(plan.object_poses[still], axis=0).max() == 0.0


def test_phases_join_without_jumps(plan: GraspPlan) -> None:
    steps = np.abs(pose_difference(plan.hand_poses[1:], plan.hand_poses[:-1]))
    # At 120 frames a second: 2.4 m/s and 24 rad/s.
    assert steps[:, :3].max() < 0.02
    assert steps[:, 3:].max() < 0.2


def test_the_hand_stays_with_the_object_while_it_carries(plan: GraspPlan) -> None:
    carrying = plan.of_phase("manipulation")
    turns = quat_to_matrix(plan.object_poses[carrying, 3:])
    palm = np.einsum(
        "nji,nj->ni", turns, plan.hand_poses[carrying, :3] - plan.object_poses[carrying, :3]
    )
    assert np.ptp(palm, axis=0).max() < 1e-6
    fingers = plan.hand_poses[carrying, 7:] - plan.hand_poses[plan.grasp_frame, 7:]
    np.testing.assert_array_equal(fingers, 0.0)


def test_reaching_keeps_out_of_object_and_table(planner: GraspSynthesizer, plan: GraspPlan) -> None:
    field = DistanceField.of(load_object("cube_50"), device="cpu")
    points = skin(planner.hand, plan.hand_poses[plan.of_phase("reaching")][::10])
    assert field.distance(points - [0.3, -0.2, 0.025]).min() > -0.001
    assert points[..., 2].min() > 0.0


def test_a_path_to_the_same_height_rises_on_its_way(planner: GraspSynthesizer) -> None:
    body = load_object("cube_50")
    target = np.array([0.25, 0.0, body.rest_height, 1.0, 0.0, 0.0, 0.0])
    moved = planner.plan(body, grip="tripod", target=target)
    assert moved.object_poses[:, 2].max() >= body.rest_height + 0.029
    np.testing.assert_allclose(moved.object_poses[-1], target, atol=1e-9)


def test_poses_of_an_object_frame_go_to_the_world() -> None:
    hand = HandModel.load().shaped()
    pose = np.zeros((1, 28))
    pose[0, :3], pose[0, 3], pose[0, 7:] = [0.1, 0.0, 0.0], 1.0, hand.rest_angles
    place = np.array([1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    wanted = skin(hand, pose) @ quat_to_matrix(place[3:]).T + place[:3]
    np.testing.assert_allclose(skin(hand, in_world(pose, place)), wanted, atol=1e-12)


def test_wrong_input_is_told_in_one_line(planner: GraspSynthesizer) -> None:
    body = load_object("cube_50")
    with pytest.raises(InputError, match="no motions of grip 'claw'"):
        planner.plan(body, grip="claw")
    with pytest.raises(InputError, match="target has shape"):
        planner.plan(body, target=np.zeros(3))
    with pytest.raises(InputError, match="start has shape"):
        planner.plan(body, start=np.zeros(7))


def test_a_left_hand_does_what_a_right_hand_does_in_a_mirror(
    planner: GraspSynthesizer, plan: GraspPlan
) -> None:
    left = GraspSynthesizer(
        HandModel.load().shaped(side="left"), database=planner.database, model=planner.model,
        config=QUICK, device="cpu",
    )  # fmt: skip
    image = left.plan(
        load_object("cube_50"), grip="tripod", start=mirror_pose(plan.hand_poses[0]),
        place=plan.object_poses[0] * FLIP_POSE, target=plan.object_poses[-1] * FLIP_POSE, seed=1,
    )  # fmt: skip
    contacts = BonePoints(bones=image.contact_bones, offsets=image.contact_local)
    grasp = image.grasp_frame
    placed = contacts.place(left.hand, image.hand_poses[grasp]) - image.object_poses[grasp, :3]
    field = DistanceField.of(load_object("cube_50"), device="cpu")
    assert np.abs(field.distance(placed)).max() < 0.003
    np.testing.assert_allclose(image.hand_poses[-1], mirror_pose(plan.hand_poses[-1]), atol=0.02)


@pytest.mark.parametrize(
    ("changes", "asked", "reason"),
    [
        ({"mass": 40.0}, {}, "too heavy: it weighs 40.00 kg"),
        ({"size": 0.3}, {}, "too big: 300 mm"),
        ({}, {"target": (3.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0)}, "out of reach"),
        ({}, {"place": (0.0, 0.0, 0.005, 1.0, 0.0, 0.0, 0.0)}, "starts 20 mm inside the table"),
        ({}, {"target": (0.2, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0)}, "inside the table"),
    ],
    ids=["too-heavy", "too-big", "out-of-reach", "starts-in-the-table", "goes-into-the-table"],
)
def test_what_no_hand_can_do_is_refused_with_its_reason(
    planner: GraspSynthesizer, changes: dict, asked: dict, reason: str
) -> None:
    size = changes.get("size", 0.05)
    cube = RigidObject.of_shape(box(size, size, size), name="cube", mass=changes.get("mass", 0.1))
    with pytest.raises(InputError, match=reason) as caught:
        planner.plan(cube, grip="tripod", **asked)
    assert "\n" not in str(caught.value)
