"""Plans that follow one another: where each begins, how they join, what is refused."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.closing import ClosingConfig
from handtrack.grasp.mirror import mirrored_plan
from handtrack.grasp.sequence import Move, joined, plan_sequence, waiting_pose
from handtrack.grasp.swarm import SwarmConfig
from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig
from handtrack.hand.model import HandModel
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import pose_difference

QUICK = SynthesisConfig(
    closing=ClosingConfig(
        swarm=SwarmConfig(particles=48, groups=4, generations=12), candidates=8, attempts=2
    ),
    release=True,
)
BLOCK = load_object("cube_50")
LEVEL = [1.0, 0.0, 0.0, 0.0]
STARTS = np.array([[0.0, y, BLOCK.rest_height, *LEVEL] for y in (0.0, 0.25)])
TARGETS = STARTS + np.array([0.3, 0.0, 0.001, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def planner() -> GraspSynthesizer:
    return GraspSynthesizer(config=QUICK, device="cpu")


@pytest.fixture(scope="module")
def plans(planner: GraspSynthesizer) -> list:
    field = DistanceField.of(BLOCK, device="cpu")
    moves = [
        Move(index=1, target=TARGETS[1], grip="tripod"),
        Move(index=0, target=TARGETS[0], grip="tripod", seed=1),
        Move(index=1, target=STARTS[1] + [0.3, 0.15, 0.001, 0, 0, 0, 0], grip="tripod", seed=2),
    ]
    return plan_sequence(planner, [BLOCK, BLOCK], STARTS, moves, distances=[field, field])


def test_every_object_is_taken_from_where_it_is(plans: list) -> None:
    assert [index for index, _ in plans] == [1, 0, 1]
    for (_, plan), start, target in zip(
        plans, (STARTS[1], STARTS[0], TARGETS[1]),
        (TARGETS[1], TARGETS[0], TARGETS[1] + [0, 0.15, 0, 0, 0, 0, 0]), strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(plan.object_poses[0], start, atol=1e-9)
        np.testing.assert_allclose(plan.object_poses[-1], target, atol=1e-9)


def test_each_plan_ends_where_the_next_one_begins(plans: list) -> None:
    for (_, plan), (_, following) in pairwise(plans):
        apart = np.abs(pose_difference(plan.hand_poses[-1], following.hand_poses[0]))
        assert apart.max() < 1e-6
        steps = np.abs(pose_difference(plan.hand_poses[1:], plan.hand_poses[:-1]))
        # At 120 frames a second: 3 m/s and 24 rad/s.
        assert steps[:, :3].max() < 0.025 and steps[:, 3:].max() < 0.2


def test_the_hand_goes_away_in_the_end_if_it_is_told_to(
    planner: GraspSynthesizer, plans: list
) -> None:
    away = waiting_pose(planner, STARTS[0])
    last = joined(planner, plans[-1:], end=away)[0][1]
    assert np.abs(pose_difference(last.hand_poses[-1], away)).max() < 1e-6
    # The object stays where it was let go.
    extra = len(last.times) - len(plans[-1][1].times)
    assert extra > 10 and not np.ptp(last.object_poses[-extra:], axis=0).any()
    assert joined(planner, [], end=away) == []


def test_the_hand_waits_on_the_same_side_of_every_object(planner: GraspSynthesizer) -> None:
    here, there = (waiting_pose(planner, place) for place in STARTS)
    np.testing.assert_allclose(there - here, np.eye(28)[1] * 0.25, atol=1e-12)


def test_a_left_hand_joins_plans_as_the_mirror_image_does(
    planner: GraspSynthesizer, plans: list
) -> None:
    left = GraspSynthesizer(
        HandModel.load().shaped(side="left"), database=planner.database, model=planner.model,
        config=QUICK, device="cpu",
    )  # fmt: skip
    images = [(index, mirrored_plan(plan)) for index, plan in plans]
    chain, expected = joined(left, images), joined(planner, plans)
    np.testing.assert_allclose(
        mirror_pose(chain[0][1].hand_poses), expected[0][1].hand_poses, atol=1e-9
    )


def test_what_cannot_be_planned_is_refused(planner: GraspSynthesizer) -> None:
    with pytest.raises(InputError, match=r"expected \(1, 7\)"):
        plan_sequence(planner, [BLOCK], STARTS, [])
    with pytest.raises(InputError, match="move 0 is of object 3"):
        plan_sequence(planner, [BLOCK], STARTS[:1], [Move(index=3, target=TARGETS[0])])
    with pytest.raises(InputError, match="0 distance fields for 1"):
        plan_sequence(planner, [BLOCK], STARTS[:1], [], distances=[])
    with pytest.raises(InputError, match="end has shape"):
        plan_sequence(planner, [BLOCK], STARTS[:1], [], end=[0.0])
    far = Move(index=0, target=[3.0, 0.0, 0.1, *LEVEL])
    with pytest.raises(InputError, match=r"move 0: .*out of reach"):
        plan_sequence(planner, [BLOCK], STARTS[:1], [far])
