"""Coordinates of both layouts: poses survive the way there and back, velocities fit positions."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.physics.hand_body import Layout, check_layout
from handtrack.physics.layout import HandLayout
from handtrack.transforms import apply_increment, quat_to_matrix


def poses(hand: ShapedHand, rng: np.random.Generator, count: int) -> np.ndarray:
    out = rng.normal(size=(count, 28))
    out[:, 3:7] /= np.linalg.norm(out[:, 3:7], axis=1, keepdims=True)
    out[:, 7:] = rng.uniform(*hand.limits.T, size=(count, 21))
    return out


def test_sizes_are_those_of_the_thesis(hand: ShapedHand) -> None:
    assert (HandLayout(hand, "tracking").nq, HandLayout(hand, "tracking").nv) == (28, 27)
    assert HandLayout(hand, "ball").nv == 33


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("name", ["tracking", "ball"])
def test_a_pose_survives_the_way_to_qpos_and_back(
    name: Layout, side: str, rng: np.random.Generator
) -> None:
    hand = HandModel.load().shaped(side=side)  # type: ignore[arg-type]
    layout = HandLayout(hand, name)
    for pose in poses(hand, rng, 5):
        np.testing.assert_allclose(layout.pose(layout.qpos(pose)), pose, atol=1e-9)


def test_many_poses_are_converted_like_one(hand: ShapedHand, rng: np.random.Generator) -> None:
    layout = HandLayout(hand, "ball")
    many = poses(hand, rng, 4)
    np.testing.assert_array_equal(layout.qpos(many), [layout.qpos(pose) for pose in many])


def test_ball_velocity_is_the_spin_in_the_bones_own_frame(
    hand: ShapedHand, rng: np.random.Generator
) -> None:
    layout = HandLayout(hand, "ball")
    pose, rates = poses(hand, rng, 1)[0], rng.normal(size=27)
    step = 1e-6
    before = quat_to_matrix(layout.qpos(pose)[7:11])
    after = quat_to_matrix(layout.qpos(apply_increment(pose, step * rates))[7:11])
    turn = (before.T @ after - np.eye(3)) / step
    spin = [turn[2, 1], turn[0, 2], turn[1, 0]]
    np.testing.assert_allclose(layout.velocity(pose, rates)[6:9], spin, atol=1e-4)


def test_degrees_of_freedom_belong_to_bones_in_order(hand: ShapedHand) -> None:
    for name in ("tracking", "ball"):
        bones = HandLayout(hand, name).bone_dofs()
        assert (bones[:6] == 0).all() and (np.diff(bones) >= 0).all() and bones[-1] == 15


def test_an_unknown_layout_is_refused() -> None:
    with pytest.raises(InputError, match="tracking, ball"):
        check_layout("euler")
