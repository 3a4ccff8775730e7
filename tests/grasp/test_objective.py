"""The objective of Eq. III.4: each term alone, weights, and several grip modes in one batch."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.grip_device import GripDevice
from handtrack.grasp.motion_model import GraspMotionModel
from handtrack.grasp.objective import TERMS, GraspObjective, ObjectiveConfig, Wish
from handtrack.grasp.swarm import SwarmConfig, draw_places, place_motions
from handtrack.grasp.taxonomy import grip_mode, grip_pads
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import keypoints, skin
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import rotvec_to_matrix
from oracles.scenes import shaped_hand

GRIPS = ("palmar_pinch", "prismatic_4_finger")


@pytest.fixture(scope="module")
def field() -> DistanceField:
    return DistanceField.of(load_object("cube_50"), device="cpu")


def closed_hand(grip: str, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A motion of three equal frames: pads about the origin, moved by a shift, (3, 28)."""
    hand, pads = shaped_hand(), grip_pads(shaped_hand(), grip)
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, grip_mode(grip).closed
    placed = BonePoints(bones=pads.bones, offsets=pads.points).place(hand, pose)
    pose[:3] -= placed.mean(0) - shift
    return np.tile(pose, (3, 1))


@cache
def on_device(device: str) -> GripDevice:
    model = GraspMotionModel.load()
    return GripDevice(shaped_hand(), [model[grip] for grip in GRIPS], device=device)


def make(field: DistanceField, device: str = "cpu", **options) -> GraspObjective:
    return GraspObjective(on_device(device), field, friction=0.8, **options)


def test_contact_is_the_sum_of_distances_in_millimetres(field: DistanceField, device: str) -> None:
    hand = shaped_hand()
    motions = np.stack([closed_hand(grip, (0.0, 0.0, 0.06)) for grip in GRIPS])
    config = ObjectiveConfig(facing=0.0)
    scores = make(field, device, config=config)(motions, [0, 1])
    for k, grip in enumerate(GRIPS):
        pads = grip_pads(hand, grip)
        placed = BonePoints(bones=pads.bones, offsets=pads.points).place(hand, motions[k, -1])
        expected = 0.4 * 1000 * np.abs(field.distance(placed)).sum()
        assert scores.terms["contact"][k] == pytest.approx(expected, rel=1e-3)
        np.testing.assert_allclose(
            field.distance(scores.points[k, : len(pads.bones)]), 0, atol=2e-3
        )


def test_collision_counts_frames_and_grows_with_depth(field: DistanceField) -> None:
    deep, far = closed_hand(GRIPS[0]), closed_hand(GRIPS[0], (0.0, 0.0, 0.5))
    mixed = np.concatenate([far[:2], deep[:1]])
    deeper = closed_hand(GRIPS[0], (0.02, 0.0, 0.0))
    scores = make(field)(np.stack([deep, far, mixed, deeper]), [0, 0, 0, 0])
    collision = scores.terms["collision"]
    assert collision[1] == 0.0
    assert collision[0] > 10.0  # d of Eq. III.7, and depth
    # The graded part grows from the tolerance on: a third of the frames costs a third.
    assert collision[2] == pytest.approx(collision[0] / 3, rel=0.1)
    order = np.argsort(scores.depths[[0, 3], 0])
    np.testing.assert_array_equal(order, np.argsort(collision[[0, 3]]))
    exact = max(0.0, -float(field.distance(skin(shaped_hand(), deep[0])).min()))
    assert scores.depths[0, 0] == pytest.approx(exact, abs=0.004)


def test_the_table_counts_like_the_object(field: DistanceField) -> None:
    motion = closed_hand(GRIPS[0], (0.0, 0.0, 0.5))[None]
    lowest = float(skin(shaped_hand(), motion[0, 0])[:, 2].min())
    free = make(field, table=(0.0, 0.0, 1.0, lowest - 0.01))(motion, [0])
    sunk = make(field, table=(0.0, 0.0, 1.0, lowest + 0.01))(motion, [0])
    assert free.terms["collision"][0] == 0.0
    assert sunk.terms["collision"][0] > 10.0
    assert sunk.depths[0, 0] == pytest.approx(0.01, abs=0.002)


def test_quality_prefers_opposite_sides_and_the_middle(field: DistanceField) -> None:
    middle, above = closed_hand(GRIPS[0]), closed_hand(GRIPS[0], (0.0, 0.0, 0.045))
    centred = ObjectiveConfig(cone=0.0)
    scores = make(field, config=centred)(np.stack([middle, above]), [0, 0])
    assert scores.terms["quality"][0] < scores.terms["quality"][1]
    # Both pads over one side of the cube press past each other: 90 degrees each beyond the cones.
    angles = make(field, config=ObjectiveConfig(centroid=0.0, balance=0.0))(above[None], [0])
    cone = np.arctan(ObjectiveConfig().cone_share * 0.8)
    assert angles.terms["quality"][0] == pytest.approx(2 * 4 * 2 * (np.pi / 2 - cone), rel=0.1)
    # There nothing cancels; in the middle both pads press against each other.
    balance = make(field, config=ObjectiveConfig(centroid=0.0, cone=0.0))
    found = balance(np.stack([middle, above]), [0, 0]).terms["quality"]
    assert found[1] == pytest.approx(2 * 8, rel=0.1)
    assert found[0] < 0.5 * found[1]


def test_prior_and_control_are_weighed(field: DistanceField) -> None:
    hand, motion = shaped_hand(), closed_hand(GRIPS[0], (0.0, 0.0, 0.06))[None]
    plain = make(field)(motion, [0], log_density=[-7.0])
    assert plain.terms["prior"][0] == pytest.approx(0.06 * 7.0)
    assert plain.terms["control"][0] == 0.0
    wanted = motion[0, -1].copy()
    wanted[0] += 0.03
    assert keypoints(hand, wanted).shape == (21, 3)
    scores = make(field, wish=Wish(hand_pose=wanted))(motion, [0])
    assert scores.terms["control"][0] == pytest.approx(0.9 * 3.0, rel=1e-6)
    goal = plain.points[0, :2] + [0.0, 0.02, 0.0]
    goal[1] = np.nan
    scores = make(field, wish=Wish(contact_points=goal))(motion, [0])
    assert scores.terms["control"][0] == pytest.approx(0.9 * 2.0, rel=1e-3)


@pytest.mark.parametrize("term", TERMS)
def test_a_weight_of_zero_drops_its_term(field: DistanceField, term: str) -> None:
    motion = closed_hand(GRIPS[1])[None]
    wish = Wish(hand_pose=closed_hand(GRIPS[1], (0.01, 0.0, 0.0))[-1])
    full = make(field, wish=wish)(motion, [1], log_density=[-3.0])
    dropped = make(field, wish=wish, config=ObjectiveConfig(**{term: 0.0}))(
        motion, [1], log_density=[-3.0]
    )
    assert full.terms[term][0] > 0
    assert dropped.terms[term][0] == 0
    assert dropped.total[0] == pytest.approx(full.total[0] - full.terms[term][0])


def test_a_motion_scores_the_same_in_any_batch(field: DistanceField) -> None:
    motions = np.stack([closed_hand(GRIPS[k % 2], (0.0, 0.0, 0.01 * k)) for k in range(6)])
    objective = make(field)
    together = objective(motions, [0, 1] * 3).total
    for k in range(6):
        assert objective(motions[k : k + 1], [k % 2]).total[0] == pytest.approx(together[k])


def drawn(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates drawn from the models, and their grip modes."""
    grips = on_device("cpu")
    width = grips.motions.nweight
    numbers, positions = np.arange(count) % len(GRIPS), np.zeros((count, width + 6))
    for k, number in enumerate(numbers):
        model = grips.models[number]
        positions[k, : model.nweight] = model.sample(rng, 1)[0]
    positions[:, width:] = draw_places(count, None, config=SwarmConfig(), rng=rng)
    return positions, numbers


def told(
    positions: np.ndarray, numbers: np.ndarray, upright: np.ndarray, nframe: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same motions and their log densities, made on the host."""
    grips = on_device("cpu")
    width = grips.motions.nweight
    motions, density = np.zeros((len(positions), nframe, 28)), np.zeros(len(positions))
    for k, number in enumerate(numbers):
        model = grips.models[number]
        weights = positions[k : k + 1, : model.nweight]
        motions[k], density[k] = model.motions(weights, nframe)[0], model.log_density(weights)[0]
    places = positions[:, width:]
    return place_motions(motions, places, upright), density + SwarmConfig().log_prior(places)


@pytest.mark.parametrize("nframe", [2, 3, 8])
@pytest.mark.parametrize("wished", [False, True])
def test_coordinates_cost_what_their_motions_cost(
    field: DistanceField, device: str, rng: np.random.Generator, nframe: int, wished: bool
) -> None:
    positions, numbers = drawn(30, rng)
    upright = rotvec_to_matrix(np.array([0.4, -0.2, 0.6]))
    wish = Wish(hand_pose=closed_hand(GRIPS[0])[-1]) if wished else None
    objective = make(field, device, wish=wish, table=(0.0, 0.6, 0.8, -0.15))
    motions, density = told(positions, numbers, upright, nframe)
    scores = objective(motions, numbers, density)
    assert (scores.terms["collision"] > 0).any()
    assert (scores.terms["collision"] == 0).any()
    options = {"nframe": nframe, "R_object_up": upright, "swarm": SwarmConfig()}
    with objective.costs([numbers], **options) as (cost,):
        found = cost(positions, np.full(30, np.inf))
    # Skin that just touches may be a collision in one and none in the other.
    off = np.abs(found - scores.total)
    assert (off < 2e-3 * scores.total + 2e-3).mean() > 0.9


def test_costs_that_are_no_lower_than_their_bounds_come_out_as_infinite(
    field: DistanceField, device: str, rng: np.random.Generator
) -> None:
    positions, numbers = drawn(30, rng)
    options = {"nframe": 8, "R_object_up": np.eye(3), "swarm": SwarmConfig()}
    with make(field, device).costs([numbers], **options) as (cost,):
        found = cost(positions, np.full(30, np.inf))
        missed = rng.random(30) < 0.5
        bounded = cost(positions, np.where(missed, found - 0.01, found + 0.01))
    np.testing.assert_array_equal(bounded, np.where(missed, np.inf, found))


def test_parts_cost_what_the_whole_costs_and_give_their_arrays_back(
    field: DistanceField, device: str, rng: np.random.Generator
) -> None:
    positions, numbers = drawn(20, rng)
    objective, none = make(field, device), np.full(20, np.inf)
    options = {"nframe": 4, "R_object_up": np.eye(3), "swarm": SwarmConfig()}
    with objective.costs([numbers], **options) as (cost,):
        whole = cost(positions, none)
    for _ in range(2):
        parts = np.arange(0, 20, 2), np.arange(1, 20, 2)
        with objective.costs([numbers[part] for part in parts], **options) as costs:
            for part, cost in zip(parts, costs, strict=True):
                np.testing.assert_array_equal(cost(positions[part], none[part]), whole[part])
    first, second = (on_device(device).borrow(10, 4) for _ in range(2))
    assert first is not second
    on_device(device).give_back(first)
    assert on_device(device).borrow(10, 4) is first


def test_unusable_settings_are_refused() -> None:
    for option in fields(ObjectiveConfig):
        with pytest.raises(InputError, match=option.name):
            ObjectiveConfig(**{option.name: -1})
