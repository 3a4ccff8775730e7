"""Grip modes: what touches and opposes, on right and left hands of any shape."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.taxonomy import DIP_SHARE, GRIP_MODES, GRIPS, grip_mode, grip_pads, posture
from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import mirror_points
from handtrack.hand.skeleton import ANGLES, BONES, FINGERS, finger_of_bone

MODEL = HandModel.load()
HAND = MODEL.shaped()


def posed(hand: ShapedHand, angles: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])


def test_there_are_ten_grip_modes_of_the_taxonomy() -> None:
    assert len(GRIPS) == 10
    assert len({mode.pads for mode in GRIP_MODES.values()}) >= 7
    assert all(1 <= mode.number <= 33 for mode in GRIP_MODES.values())


@pytest.mark.parametrize("name", GRIPS)
def test_the_thumb_opposes_every_other_finger_that_closes(name: str) -> None:
    mode = grip_mode(name)
    fingers = [finger_of_bone(bone) for bone in mode.bones.tolist()]
    assert fingers[0] == FINGERS.index("thumb")
    assert {FINGERS[fingers[k]] for pair in mode.pairs for k in pair} == set(mode.fingers)
    assert all(first == 0 and second > 0 for first, second in mode.pairs)
    assert mode.power == ("palm" in {BONES[bone] for bone in mode.bones})


@pytest.mark.parametrize("name", GRIPS)
def test_closed_and_open_hands_stay_within_the_joint_limits(name: str) -> None:
    mode, (low, high) = grip_mode(name), HAND.limits.T
    closed, opened = np.array(mode.closed), np.array(mode.closed) + np.array(mode.opening)
    assert (closed >= low).all() and (closed <= high).all()
    assert (opened >= low - 1e-9).all() and (opened <= high + 1e-9).all()


@pytest.mark.parametrize("name", GRIPS)
def test_opening_moves_the_fingers_away_from_the_thumb_and_no_others(name: str) -> None:
    mode, pads = grip_mode(name), grip_pads(HAND, name)
    still = [k for k, angle in enumerate(ANGLES) if angle.split("_")[0] not in mode.fingers]
    assert not np.array(mode.opening)[still].any()
    gaps = []
    for angles in (mode.closed, np.add(mode.closed, mode.opening)):
        rotations, origins = bone_frames(HAND, posed(HAND, np.array(angles)))
        places = np.einsum("cij,cj->ci", rotations[pads.bones], pads.points) + origins[pads.bones]
        gaps.append([np.linalg.norm(places[a] - places[b]) for a, b in pads.pairs])
    assert (np.array(gaps[1]) > np.array(gaps[0]) + 0.01).all()


@pytest.mark.parametrize("name", GRIPS)
def test_pads_lie_on_the_palmar_skin(name: str) -> None:
    pads = grip_pads(HAND, name)
    pose = posed(HAND, np.zeros(21))
    rotations, origins = bone_frames(HAND, pose)
    places = np.einsum("cij,cj->ci", rotations[pads.bones], pads.points) + origins[pads.bones]
    vertices = skin(HAND, pose)
    away = np.linalg.norm(vertices[None] - places[:, None], axis=2).min(1)
    # Vertices of the palm are farther apart than those of the fingers.
    assert (away < np.where(pads.bones == 0, 0.010, 0.006)).all()
    np.testing.assert_allclose(np.linalg.norm(pads.normals, axis=1), 1.0, atol=1e-9)
    assert (pads.normals[:, 1] > 0.6).all()  # y is palmar in every bone frame


def test_a_left_hand_has_the_mirrored_pads() -> None:
    for name in GRIPS:
        right, left = grip_pads(HAND, name), grip_pads(MODEL.shaped(side="left"), name)
        np.testing.assert_allclose(left.points, mirror_points(right.points), atol=1e-9)
        np.testing.assert_allclose(left.normals, mirror_points(right.normals), atol=1e-9)


def test_pads_grow_with_the_hand() -> None:
    large = MODEL.shaped(HandShape(scale=1.2))
    ratio = grip_pads(large, "tripod").points[:, 0] / grip_pads(HAND, "tripod").points[:, 0]
    np.testing.assert_allclose(ratio, 1.2, rtol=0.02)


def test_end_joints_follow_middle_joints_in_a_posture() -> None:
    angles = dict(zip(ANGLES, posture(index=(10, 5, 60)), strict=True))
    assert angles["index_dip_flexion"] == pytest.approx(DIP_SHARE * angles["index_pip_flexion"])
    assert angles["index_mcp_flexion"] == pytest.approx(np.deg2rad(10))
    assert not any(value for name, value in angles.items() if not name.startswith("index"))


def test_an_unknown_grip_mode_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="palmar_pinch"):
        grip_mode("karate")
