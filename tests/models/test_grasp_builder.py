"""The builder of the grasp database."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

MODELS = Path(__file__).resolve().parents[2] / "models"
sys.path.insert(0, str(MODELS))

from grasp_builder.building import BuildConfig, Builder, BuildLog  # noqa: E402
from grasp_builder.fitting import GraspFit  # noqa: E402
from grasp_builder.moving import minimum_jerk, transport  # noqa: E402
from grasp_builder.placing import MANNERS, draw_placing  # noqa: E402
from grasp_builder.proving import holds  # noqa: E402

from handtrack.grasp.taxonomy import DIP_SHARE, GRIPS, grip_mode, grip_pads  # noqa: E402
from handtrack.hand.kinematics import skin  # noqa: E402
from handtrack.hand.model import HandModel  # noqa: E402
from handtrack.hand.skeleton import ANGLES  # noqa: E402
from handtrack.objects.distance_field import DistanceField  # noqa: E402
from handtrack.objects.library import DATABASE_OBJECTS, load_object  # noqa: E402
from handtrack.physics.bone_solids import bone_solids  # noqa: E402


@pytest.fixture(scope="module")
def hand():
    return HandModel.load().shaped()


@pytest.fixture(scope="module")
def ball():
    thing = load_object("ball_65")
    return thing, DistanceField.of(thing, device="cpu", spacing=0.003)


def test_every_grip_mode_has_a_manner_and_every_database_object_a_grip():
    assert set(MANNERS) == set(GRIPS)
    used = {name for manner in MANNERS.values() for name in manner.objects}
    assert used == set(DATABASE_OBJECTS)


def test_placings_press_level_with_the_approach_at_a_right_angle_to_it(ball):
    for seed in range(20):
        placing = draw_placing(MANNERS["tripod"], ball[0], np.random.default_rng(seed))
        assert abs(placing.press @ placing.approach) < 1e-9
        assert placing.approach[0] > 0.0 and placing.approach[2] < 0.0
        assert placing.press[1] < -0.8  # thumb on the left of a right hand that comes along x


def test_blocks_are_taken_across_a_narrow_pair_of_sides():
    block = load_object("block_30_80_50")
    for seed in range(10):
        placing = draw_placing(MANNERS["palmar_pinch"], block, np.random.default_rng(seed))
        across = placing.turn.T @ placing.press
        level = across[:2] / np.linalg.norm(across[:2])
        assert abs(level[0]) > np.cos(np.deg2rad(15.0))


def test_a_fitted_grasp_touches_with_every_pad_and_enters_nowhere(hand, ball):
    thing, distances = ball
    fit = GraspFit(hand, grip_mode("tripod"), grip_pads(hand, "tripod"), distances,
                   -thing.rest_height)  # fmt: skip
    placing = draw_placing(MANNERS["tripod"], thing, np.random.default_rng(1))
    grasp = fit.fit(placing, fit.start(placing))
    assert np.abs(fit.distance(placing, fit.places(grasp))).max() < 0.0015
    assert fit.distance(placing, skin(hand, grasp)).min() > -0.0015
    assert (grasp[7:] >= hand.limits[:, 0] - 1e-9).all()
    assert (grasp[7:] <= hand.limits[:, 1] + 1e-9).all()
    for finger in ("index", "middle"):
        middle, end = (grasp[7 + ANGLES.index(f"{finger}_{j}_flexion")] for j in ("pip", "dip"))
        assert abs(end - DIP_SHARE * middle) < np.deg2rad(8.0)


def test_built_recordings_open_before_they_close_and_carry_the_object(hand, ball):
    thing, distances = ball
    log = BuildLog()
    solids = bone_solids(hand)
    builder = Builder(hand, "tripod", thing, distances, solids, BuildConfig(trials=2), log)
    made = builder.recordings()
    assert made and log.kept["tripod"] == len(made)
    for item in made:
        index = 7 + ANGLES.index("index_mcp_flexion")
        reach = item.hand_poses[item.of_phase("reaching"), index]
        start, end = item.hand_poses[item.of_phase("closing")[[0, -1]], index]
        assert reach.min() < start < end
        lift = item.object_poses[:, 2].max() - item.object_poses[0, 2]
        assert lift > 0.09
        assert ("releasing" in item.phases) == (item.trial % 2 == 1)
        steps = np.abs(np.diff(item.hand_poses[:, :3], axis=0)).max()
        assert steps < 0.015  # 1.8 m/s


def test_only_what_holds_under_physics_is_a_recording(hand, ball):
    thing, distances = ball
    solids = bone_solids(hand)
    builder = Builder(hand, "tripod", thing, distances, solids, BuildConfig(trials=1), BuildLog())
    made = builder.recordings()[0]
    there = {"hand": hand, "distances": distances, "solids": solids}
    assert holds(made, thing, **there)
    beside = made.hand_poses.copy()
    beside[:, 1] += 0.02
    assert not holds(replace(made, hand_poses=beside), thing, **there)


def test_minimum_jerk_starts_and_ends_at_rest():
    share = minimum_jerk(np.linspace(0.0, 1.0, 1001))
    assert share[0] == 0.0 and np.isclose(share[-1], 1.0)
    speed = np.diff(share)
    assert speed[0] < 1e-6 and speed[-1] < 1e-6 and (speed >= 0.0).all()


def test_things_that_are_set_down_end_on_the_table():
    class Timing:
        manipulation = 1.0

    first = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    path = transport(first, Timing(), np.random.default_rng(0), lands=True)
    assert abs(path[-1, 2]) < 1e-9 and path[:, 2].max() > 0.1
    np.testing.assert_allclose(path[-1, 4:6], 0.0, atol=1e-9)
