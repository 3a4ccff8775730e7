"""Grasps under physics: a tripod lifts, carries, holds and sets down; what a run says of itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.run import Goal, GraspRun
from handtrack.grasp.simulation import FallingBall, SimulationConfig, simulate, simulate_sequence
from handtrack.hand.model import HandModel
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box, sphere
from handtrack.physics.bone_solids import bone_solids
from oracles.handmade_grasp import handmade_plan

HAND = HandModel.load().shaped()
THINGS = {
    "block": RigidObject.of_shape(box(0.05, 0.05, 0.05), name="block", mass=0.1),
    "ball": RigidObject.of_shape(sphere(0.06), name="ball", mass=0.1),
}
BRIEF = SimulationConfig(goal=Goal(hold=0.3), record_interval=20)


@pytest.fixture(scope="module")
def plans() -> dict[str, GraspPlan]:
    return {name: handmade_plan(HAND, thing, carry_time=0.7) for name, thing in THINGS.items()}


@pytest.fixture(scope="module")
def shared() -> dict[str, dict]:
    """What runs with one hand and one object share."""
    solids = bone_solids(HAND)
    return {
        name: {"hand": HAND, "solids": solids, "distances": DistanceField.of(thing)}
        for name, thing in THINGS.items()
    }


@pytest.fixture(scope="module")
def calm(plans, shared) -> GraspRun:
    """The block grasped without anything in the way."""
    return simulate(plans["block"], THINGS["block"], config=BRIEF, **shared["block"])


def test_a_tripod_grasp_lifts_carries_and_holds_a_block(calm: GraspRun) -> None:
    assert calm.success, calm.failure
    assert calm.position_error < 0.01 and calm.rotation_error < np.deg2rad(5.0)
    assert not calm.driven_objects


def test_the_same_of_a_ball_that_rolls_when_pushed(plans, shared) -> None:
    run = simulate(plans["ball"], THINGS["ball"], config=BRIEF, **shared["ball"])
    assert run.success, run.failure


@pytest.mark.parametrize("variant", ["pd", "pollard-zordan"])
def test_without_contact_forces_the_ball_stays_behind(variant, plans, shared) -> None:
    run = simulate(
        plans["ball"], THINGS["ball"], controller=variant, config=BRIEF, **shared["ball"]
    )
    assert not run.success and run.lift < 0.02
    assert run.failure is not None and run.failure.startswith("lifted")


def test_a_heavier_and_slipperier_block_is_held_with_more_force(plans, shared, calm) -> None:
    run = simulate(
        plans["block"], THINGS["block"], config=BRIEF, mass=0.2, friction=0.5, **shared["block"]
    )
    assert run.success, run.failure
    press = [r.contact_forces[r.holding].sum(1).mean() for r in (run, calm)]
    assert press[0] > 1.5 * press[1]


def test_hold_survives_a_light_ball_that_falls_on_it(plans, shared, calm) -> None:
    ball = FallingBall(mass=0.02, height=0.1, time=0.05)
    run = simulate(plans["block"], THINGS["block"], config=BRIEF, balls=[ball], **shared["block"])
    assert run.success, run.failure
    assert np.abs(run.object_poses - calm.object_poses).max() > 1e-4


def test_ball_jointed_hand_grasps_as_well(plans, shared) -> None:
    run = simulate(
        plans["block"], THINGS["block"], config=replace(BRIEF, layout="ball"), **shared["block"]
    )
    assert run.success, run.failure


def moved_on(plan: GraspPlan, aside: float) -> GraspPlan:
    """The same further along x, after an arch from where the plan ends."""
    hands, things = plan.hand_poses.copy(), plan.object_poses.copy()
    hands[:, 0] += aside
    things[:, 0] += aside
    corners = np.stack([plan.hand_poses[-1], plan.hand_poses[-1], hands[0], hands[0]])
    corners[1:3, 2] += 0.12
    frames = np.linspace(0.0, 3.0, 72, endpoint=False)
    way = np.stack([np.interp(frames, np.arange(4), column) for column in corners.T], axis=1)
    count = len(frames) + len(hands)
    return replace(
        plan,
        times=np.arange(count) / 60.0,
        hand_poses=np.concatenate([way, hands]),
        object_poses=np.concatenate([np.tile(things[0], (len(frames), 1)), things]),
        phases=np.concatenate([np.repeat("reaching", len(frames)), plan.phases]),
    )


def test_blocks_are_set_down_one_after_another(shared) -> None:
    block = THINGS["block"]
    plan = handmade_plan(HAND, block, carry=(0.0, 0.15, 0.001), carry_time=0.9, set_down=True)
    starts = np.array([[0.0, 0.0, block.rest_height, 1, 0, 0, 0]] * 2)
    starts[1, 0] = 0.25
    second = moved_on(plan, 0.25)
    runs, ends = simulate_sequence(
        [(0, plan), (1, second)], [block, block], starts, hand=HAND, config=BRIEF,
        solids=shared["block"]["solids"],
    )  # fmt: skip
    for run in runs:
        assert run.lift > 0.1 and run.set_down
        assert run.placed_error < 0.01, run.failure
        assert run.supported[-1] and not run.contact_forces[-1].any()
    # The second run leaves the first block where it is.
    assert len(runs) == 2 and abs(runs[1].object_poses[0, 0] - 0.25) < 1e-3
    np.testing.assert_allclose(ends[0], runs[0].object_poses[-1], atol=1e-3)
    np.testing.assert_allclose(ends[1], runs[1].object_poses[-1], atol=1e-6)
    for number, run in enumerate(runs):
        assert run.scene_poses.shape == (len(run.times), 2, 7)
        np.testing.assert_array_equal(run.scene_poses[:, number], run.object_poses)
    # While the first is carried the second waits where it stood, and it goes on from there.
    assert np.ptp(runs[0].scene_poses[:, 1, :3], axis=0).max() < 1e-3
    np.testing.assert_allclose(runs[1].scene_poses[0], runs[0].scene_poses[-1], atol=1e-3)


def a_run(**changes) -> GraspRun:
    times = np.arange(400) * 0.01
    things = np.zeros((400, 7))
    things[:, 3] = 1.0
    things[:, 2] = np.clip(times, 0.0, 1.0) * 0.15
    things[:, 1] = np.clip(times, 0.0, 1.0) * 0.2
    given = {
        "times": times, "hand_poses": np.zeros((400, 28)), "object_poses": things,
        "scene_poses": things[:, None], "targets": things.copy(),
        "contact_forces": np.ones((400, 16)),
        "holding": times >= 2.0, "supported": times < 0.1, "contact_depth": 0.001,
        "skin_depth": 0.002, "wall_time": 2.0, "force_times": np.zeros(0),
        "driven_objects": False, "goal": Goal(), **changes,
    }  # fmt: skip
    return GraspRun(**given)


def test_a_run_that_meets_every_condition_is_a_success() -> None:
    run = a_run()
    assert run.success and run.failure is None
    assert run.carry == pytest.approx(0.25) and run.lift == pytest.approx(0.15)
    assert run.realtime_factor == pytest.approx(3.99 / 2.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"skin_depth": 0.0035}, "entered by 3.5 mm"),
        ({"burst": True}, "unstable"),
        ({"driven_objects": True}, "drove an object"),
        ({"supported": np.ones(400, bool)}, "alone"),
        ({"contact_forces": np.zeros((400, 16))}, "alone"),
        ({"holding": np.arange(400) >= 250}, "whole time"),
        ({"targets": a_run().targets + 0.03 * np.eye(7)[0]}, "30 mm from the target"),
        ({"targets": np.tile([0, 0.2, 0.15, 0.9, 0.4, 0, 0], (400, 1))}, "degrees"),
        ({"object_poses": np.tile([0, 0, 0, 1.0, 0, 0, 0], (400, 1))}, "lifted 0 mm"),
    ],
)
def test_a_run_says_what_went_wrong(changes: dict, message: str) -> None:
    run = a_run(**changes)
    assert not run.success
    assert run.failure is not None and message in run.failure
