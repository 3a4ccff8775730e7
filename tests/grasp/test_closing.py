"""Closing motions that end in grasps: they touch, stay outside, hold, and repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.closing import ClosingConfig, ClosingGrasp, ClosingSynthesizer
from handtrack.grasp.feasibility import feasible
from handtrack.grasp.motion_model import GraspMotionModel
from handtrack.grasp.objective import Wish
from handtrack.grasp.recording import grasp_yaw
from handtrack.grasp.swarm import SwarmConfig
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

QUICK = ClosingConfig(
    swarm=SwarmConfig(particles=48, groups=4, generations=12),
    screening=SwarmConfig(particles=8, groups=1, generations=3), candidates=8, attempts=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def hand() -> ShapedHand:
    return HandModel.load().shaped()


@pytest.fixture(scope="module")
def model() -> GraspMotionModel:
    return GraspMotionModel.load()


@pytest.fixture(scope="module")
def cube_field() -> DistanceField:
    return DistanceField.of(load_object("cube_50"), device="cpu")


def close(
    hand: ShapedHand, model: GraspMotionModel, field: DistanceField, *grips: str, yaw: float = 0.4,
    turn: float = 0.0, wish: Wish | None = None, config: ClosingConfig = QUICK, seed: int = 0,
) -> ClosingGrasp:  # fmt: skip
    body = load_object("cube_50")
    quat = matrix_to_quat(rotvec_to_matrix(np.array([0.0, 0.0, turn])))
    place = np.concatenate([[0.3, -0.2, body.rest_height], quat])
    return ClosingSynthesizer(
        hand, body, field, [model[grip] for grip in grips], place=place, yaw=yaw, wish=wish,
        config=config, device="cpu",
    ).run(seed)  # fmt: skip


@pytest.fixture(scope="module")
def tripod(hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField) -> ClosingGrasp:
    return close(hand, model, cube_field, "tripod")


def test_a_grasp_of_a_cube_can_carry_it_and_does_not_enter_it(
    hand: ShapedHand, cube_field: DistanceField, tripod: ClosingGrasp
) -> None:
    assert tripod.grip == "tripod"
    assert tripod.feasible
    contacts = BonePoints(bones=tripod.pads.bones, offsets=tripod.pads.points)
    gaps = cube_field.distance(contacts.place(hand, tripod.motion[-1]))
    assert np.abs(gaps).max() < 0.003
    assert cube_field.distance(skin(hand, tripod.motion[-1])).min() > -0.003
    assert cube_field.distance(skin(hand, tripod.motion[0])).min() > 0.0
    assert skin(hand, tripod.motion[-1])[:, 2].min() > -load_object("cube_50").rest_height
    np.testing.assert_allclose(np.linalg.norm(tripod.normals, axis=1), 1.0, atol=1e-5)
    assert np.abs(cube_field.distance(tripod.points)).max() < 1e-3


def test_a_grasp_comes_from_the_wanted_side(tripod: ClosingGrasp) -> None:
    off = grasp_yaw(tripod.motion[-1], np.zeros(3)) - 0.4
    assert abs(np.angle(np.exp(1j * off))) < 1.2


def test_the_same_seed_gives_the_same_grasp(
    hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField, tripod: ClosingGrasp
) -> None:
    again = close(hand, model, cube_field, "tripod")
    np.testing.assert_array_equal(again.motion, tripod.motion)
    assert again.costs == tripod.costs


def test_a_turned_object_is_grasped_in_its_own_frame(
    hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField, tripod: ClosingGrasp
) -> None:
    turned = close(hand, model, cube_field, "tripod", yaw=0.9, turn=0.5)
    # Turned together with the side it is to come from: the same search in the object's frame.
    np.testing.assert_allclose(turned.motion[:, :3], tripod.motion[:, :3], atol=2e-3)


def test_wanted_contacts_draw_the_grasp(
    hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField, tripod: ClosingGrasp
) -> None:
    wanted = np.full((3, 3), np.nan)
    wanted[0] = [0.025, 0.0, 0.01]
    drawn = replace(QUICK, objective=replace(QUICK.objective, control=9.0))
    found = close(
        hand, model, cube_field, "tripod", yaw=np.pi, wish=Wish(contact_points=wanted), config=drawn
    )
    assert np.linalg.norm(found.points[0] - wanted[0]) < 0.02
    assert np.linalg.norm(found.points[0] - wanted[0]) < np.linalg.norm(
        tripod.points[0] - wanted[0]
    )


def test_without_a_grip_one_of_all_is_chosen(
    hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField
) -> None:
    found = close(hand, model, cube_field, *model.grips)
    assert found.grip in model.grips
    assert found.feasible
    assert set(found.costs) == {"prior", "control", "collision", "contact", "quality"}


def test_a_grasp_tells_with_how_much_friction_it_can_carry(tripod: ClosingGrasp) -> None:
    body = load_object("cube_50")
    up = np.array([0.0, 0.0, 1.0])

    def carries(share: float) -> bool:
        return feasible(
            tripod.points, tripod.normals, friction=share * body.friction,
            mass=QUICK.load * body.mass, gravity=-9.81 * up,
        ).feasible  # fmt: skip

    shares = QUICK.friction_shares
    assert tripod.friction_share in shares
    assert carries(tripod.friction_share)
    assert not any(carries(share) for share in shares if share < tripod.friction_share)


def test_of_clear_grasps_the_one_that_needs_least_friction_is_taken(
    hand: ShapedHand, model: GraspMotionModel, cube_field: DistanceField
) -> None:
    # With one share all feasible grasps are alike, and cost decides.
    alike = replace(QUICK, friction_shares=(0.6,), candidates=8)
    ranked = replace(QUICK, friction_shares=(0.05, 0.1, 0.15, 0.2, 0.3, 0.6), candidates=8)
    body = load_object("cube_50")

    def need(config: ClosingConfig, seed: int) -> float:
        found = close(hand, model, cube_field, "tripod", config=config, seed=seed)
        return next(
            (
                friction
                for friction in np.arange(0.02, 0.8, 0.02)
                if feasible(
                    found.points, found.normals, friction=friction, mass=QUICK.load * body.mass
                ).feasible
            ),
            np.inf,
        )

    needs = np.array([[need(config, seed) for config in (alike, ranked)] for seed in range(3)])
    assert np.isfinite(needs).all()
    assert (needs[:, 1] <= needs[:, 0] + 0.041).all()
    assert needs[:, 1].mean() < needs[:, 0].mean()


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="frames is 1"):
        ClosingConfig(frames=1)
    for shares in ((), (0.4, 0.4), (0.0, 0.5), (0.5, 1.1)):
        with pytest.raises(InputError, match="friction_shares"):
            ClosingConfig(friction_shares=shares)
