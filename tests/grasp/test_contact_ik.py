"""Pulling contacts onto objects: they touch, nothing enters, and the pose stays a hand's."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.contact_ik import ContactIkConfig, blend_correction, pull_contacts
from handtrack.grasp.taxonomy import GripPads, grip_mode, grip_pads
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import matrix_to_quat, pose_difference, rotvec_to_matrix
from oracles.scenes import shaped_hand

CONFIG = ContactIkConfig(iterations=40)


def about_the_object(
    hand: ShapedHand, grip: str, rng: np.random.Generator, count: int, pitch: float
) -> np.ndarray:
    """Rough grasps: the grip's closed hand, fingers down, pads about the object's middle."""
    pads = grip_pads(hand, grip)
    c, s = np.cos(pitch), np.sin(pitch)
    down = np.stack([[c, 0, -s], [-s, 0, -c], [0, 1, 0]], 1)
    poses = np.zeros((count, 28))
    poses[:, 3:7] = matrix_to_quat(down @ rotvec_to_matrix(0.08 * rng.normal(size=(count, 3))))
    poses[:, 7:] = np.array(grip_mode(grip).closed) + 0.04 * rng.normal(size=(count, 21))
    poses[:, 7:] = poses[:, 7:].clip(*hand.limits.T)
    placed = BonePoints(bones=pads.bones, offsets=pads.points).place(hand, poses)
    middles = np.mean([placed[:, pair].mean(1) for pair in pads.pairs.tolist()], axis=0)
    poses[:, :3] -= middles - 0.003 * rng.normal(size=(count, 3))
    return poses


@pytest.mark.parametrize(
    ("name", "grip", "pitch"),
    [("cube_50", "tripod", 0.9), ("egg", "palmar_pinch", 1.0), ("cylinder_45_90", "tripod", 0.7)],
)
def test_contacts_come_to_touch_and_skin_stays_out(
    name: str, grip: str, pitch: float, rng: np.random.Generator
) -> None:
    hand, body = shaped_hand(), load_object(name)
    field, pads = DistanceField.of(body, device="cpu"), grip_pads(hand, grip)
    table = np.array([0, 0, 1, -body.rest_height])
    rough = about_the_object(hand, grip, rng, 6, pitch)
    pulled = pull_contacts(hand, rough, [pads] * 6, field, table=table, config=CONFIG)
    contacts = BonePoints(bones=pads.bones, offsets=pads.points)
    before = np.abs(field.distance(contacts.place(hand, rough))).max(1)
    gaps = field.distance(contacts.place(hand, pulled.poses))
    np.testing.assert_allclose(pulled.gaps, gaps, atol=1e-9)
    off = np.abs(gaps + CONFIG.depth).max(1)
    assert np.median(before) > 0.004
    assert np.median(off) < 0.0015
    vertices = skin(hand, pulled.poses)
    depths = np.maximum(-field.distance(vertices).min(1), 0.0)
    assert np.median(depths) < 0.002
    assert np.quantile(np.abs(depths - pulled.depths), 0.8) < 0.0015
    assert (vertices[..., 2] + body.rest_height).min() > -0.002
    low, high = hand.limits.T
    assert (pulled.poses[:, 7:] >= low - 1e-9).all()
    assert (pulled.poses[:, 7:] <= high + 1e-9).all()
    np.testing.assert_allclose(field.distance(pulled.surface), 0.0, atol=6e-4)


def test_poses_of_one_batch_do_not_hear_of_each_other(rng: np.random.Generator) -> None:
    hand, body = shaped_hand(), load_object("cube_50")
    field = DistanceField.of(body, device="cpu")
    table = np.array([0, 0, 1, -body.rest_height])
    grips = ["tripod", "palmar_pinch", "quadpod"]
    pads = [grip_pads(hand, grip) for grip in grips]
    rough = np.concatenate([about_the_object(hand, grip, rng, 1, 0.9) for grip in grips])
    together = pull_contacts(hand, rough, pads, field, table=table)
    for k in range(3):
        alone = pull_contacts(hand, rough[k : k + 1], pads[k : k + 1], field, table=table)
        np.testing.assert_allclose(together.poses[k], alone.poses[0], atol=1e-6)
        count = len(pads[k].bones)
        assert np.isfinite(together.gaps[k, :count]).all()
        assert np.isnan(together.gaps[k, count:]).all()


def test_a_pose_that_already_grasps_hardly_moves(rng: np.random.Generator) -> None:
    hand, body = shaped_hand(), load_object("cube_50")
    field, pads = DistanceField.of(body, device="cpu"), grip_pads(hand, "tripod")
    table = np.array([0, 0, 1, -body.rest_height])
    rough = about_the_object(hand, "tripod", rng, 1, 0.9)
    once = pull_contacts(hand, rough, [pads], field, table=table, config=CONFIG).poses
    twice = pull_contacts(hand, once, [pads], field, table=table, config=CONFIG).poses
    moved, first = pose_difference(twice, once)[0], pose_difference(once, rough)[0]
    assert np.abs(moved[:3]).max() < 0.002
    assert np.linalg.norm(moved[6:]) < 0.5 * np.linalg.norm(first[6:])


def test_a_corrected_motion_keeps_its_start_and_ends_in_the_correction() -> None:
    motion = np.zeros((30, 28))
    motion[:, 3] = 1.0
    motion[:, 12] = np.linspace(0.0, 0.8, 30)
    final = motion[-1].copy()
    final[0], final[12] = 0.01, 0.9
    blended = blend_correction(motion, final, start=0.3)
    np.testing.assert_allclose(blended[-1], final, atol=1e-12)
    np.testing.assert_allclose(blended[:9], motion[:9], atol=1e-12)
    steps = np.diff(blended[:, 0])
    assert (steps >= -1e-12).all()
    assert steps.max() < 0.001  # no jump


def test_unusable_input_is_refused() -> None:
    hand, field = shaped_hand(), DistanceField.of(load_object("egg"), device="cpu")
    pads: list[GripPads] = [grip_pads(hand, "tripod")]
    with pytest.raises(InputError, match="one grip for each pose"):
        pull_contacts(hand, np.zeros((2, 28)), pads, field, table=[0, 0, 1, -1])
    with pytest.raises(InputError, match="depth is -1"):
        ContactIkConfig(depth=-1.0)
    with pytest.raises(InputError, match="at least 1"):
        ContactIkConfig(iterations=0)
