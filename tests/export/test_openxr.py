"""The 26 joints against the hand's keypoints and the rules of the OpenXR specification."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtrack.export.openxr import JOINTS, METACARPAL_TO_PROXIMAL, JointSet, openxr
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames, keypoints, skin
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.side import Side
from oracles.winding import winding_numbers

Float = NDArray[np.float64]

UPRIGHT = np.array([1.0, -1.0, -1.0])

KEYPOINT_JOINTS = [
    "wrist", "thumb_metacarpal", "thumb_proximal", "thumb_distal", "thumb_tip",
    *(f"{finger}_{part}" for finger in ("index", "middle", "ring", "little")
      for part in ("proximal", "intermediate", "distal", "tip")),
]  # fmt: skip
"""The joint in the place of each of the 21 keypoints."""

FINGERS = {
    "thumb": ("metacarpal", "proximal", "distal", "tip"),
    **{
        finger: ("metacarpal", "proximal", "intermediate", "distal", "tip")
        for finger in ("index", "middle", "ring", "little")
    },
}


@pytest.fixture(scope="module")
def lines(track: Track) -> list[dict[str, Any]]:
    return [json.loads(line) for line in openxr(track).decode("ascii").splitlines()]


def placed(line: dict[str, Any]) -> tuple[dict[str, Float], dict[str, Float]]:
    """Position and rotation matrix of every joint of a line."""
    points, turns = {}, {}
    for name, joint in zip(JOINTS, line["jointLocations"], strict=True):
        points[name] = np.array([joint["pose"]["position"][axis] for axis in "xyz"])
        quat = [joint["pose"]["orientation"][axis] for axis in "xyzw"]
        assert np.linalg.norm(quat) == pytest.approx(1.0, abs=1e-6)
        turns[name] = Rotation.from_quat(quat).as_matrix()
    return points, turns


def flat_pose() -> Float:
    """Right or left hand, all angles 0, palm frame along the camera's axes."""
    pose = np.zeros(28)
    pose[2], pose[3] = 0.5, 1.0
    return pose


def located(hand: ShapedHand, pose: Float) -> tuple[dict[str, Float], dict[str, Float]]:
    """Joints of a pose in the camera frame."""
    points, turns = JointSet.of(hand).located(hand, pose)
    return dict(zip(JOINTS, points, strict=True)), dict(zip(JOINTS, turns, strict=True))


def test_the_order_is_that_of_the_extension() -> None:
    # Numbers of XrHandJointEXT.
    numbers = {"palm": 0, "wrist": 1, "thumb_metacarpal": 2, "thumb_tip": 5}
    numbers |= {"index_metacarpal": 6, "index_intermediate": 8, "index_tip": 10}
    numbers |= {"middle_metacarpal": 11, "ring_metacarpal": 16, "ring_distal": 19}
    numbers |= {"little_metacarpal": 21, "little_proximal": 22, "little_tip": 25}
    assert len(JOINTS) == 26
    assert all(JOINTS[number] == name for name, number in numbers.items())


def test_every_frame_is_there_and_lost_ones_are_not_active(
    lines: list[dict[str, Any]], track: Track
) -> None:
    assert [line["isActive"] for line in lines] == track.followed.tolist()
    for place, line in enumerate(lines):
        assert line["hand"] == f"XR_HAND_{track.side.upper()}_EXT"
        assert line["frame"] == place and line["time"] == track.times[place]
        assert len(line["jointLocations"]) == (26 if line["isActive"] else 0)
        assert all(joint["locationFlags"] == 15 for joint in line["jointLocations"])
        assert all(joint["radius"] > 0.0 for joint in line["jointLocations"])


def test_joints_are_where_the_keypoints_are(lines: list[dict[str, Any]], track: Track) -> None:
    for place in np.flatnonzero(track.followed):
        points, _ = placed(lines[place])
        for name, keypoint in zip(KEYPOINT_JOINTS, track.keypoints[place], strict=True):
            assert 1e3 * np.linalg.norm(points[name] - keypoint * UPRIGHT) < 0.01


def test_a_hand_whose_size_was_corrected_has_its_size_of_each_frame(track: Track) -> None:
    sizes = np.where(np.arange(len(track)) < 6, 1.04, 1.0)
    points = np.stack(
        [
            keypoints(track.hand.scaled(size), pose)
            for size, pose in zip(sizes, track.poses, strict=True)
        ]
    )
    resized = replace(track, keypoints=points)
    lines = openxr(resized).decode("ascii").splitlines()
    usual = openxr(track).decode("ascii").splitlines()
    for place in np.flatnonzero(track.followed):
        line, before = json.loads(lines[place]), json.loads(usual[place])
        found, _ = placed(line)
        for name, keypoint in zip(KEYPOINT_JOINTS, points[place], strict=True):
            assert 1e3 * np.linalg.norm(found[name] - keypoint * UPRIGHT) < 0.01
        ratio = line["jointLocations"][1]["radius"] / before["jointLocations"][1]["radius"]
        assert ratio == pytest.approx(sizes[place], abs=1e-4)


def test_joints_turn_as_the_bones_do(lines: list[dict[str, Any]], track: Track) -> None:
    """Forward is the bone's x, up its -y, right its -z, whichever hand it is."""
    rotations, _ = bone_frames(track.hand, track.poses)
    for place in np.flatnonzero(track.followed):
        _, turns = placed(lines[place])
        bone = UPRIGHT[:, None] * rotations[place, 5]
        expected = np.stack([-bone[:, 2], -bone[:, 1], -bone[:, 0]], axis=1)
        turn = turns["index_intermediate"].T @ expected
        assert np.rad2deg(Rotation.from_matrix(turn).magnitude()) < 0.01


def test_forward_points_along_the_bone_to_the_tip(
    lines: list[dict[str, Any]], track: Track
) -> None:
    for place in np.flatnonzero(track.followed):
        points, turns = placed(lines[place])
        for finger, parts in FINGERS.items():
            chain = [f"{finger}_{part}" for part in parts]
            for joint, beyond in pairwise(chain):
                along = points[beyond] - points[joint]
                cosine = -turns[joint][:, 2] @ along / np.linalg.norm(along)
                assert np.rad2deg(np.arccos(min(cosine, 1.0))) < 0.1, joint
            np.testing.assert_allclose(turns[chain[-1]], turns[chain[-2]], atol=1e-6)
        for joint, beyond in (("wrist", "middle_metacarpal"), ("palm", "middle_proximal")):
            along = points[beyond] - points[joint]
            cosine = -turns[joint][:, 2] @ along / np.linalg.norm(along)
            assert np.rad2deg(np.arccos(cosine)) < 3.0, joint


def test_up_is_out_of_the_back_and_right_follows(side: Side) -> None:
    hand = HandModel.load().shaped(side=side)
    pose = flat_pose()
    points, turns = located(hand, pose)
    # The back of a flat hand is where fingers do not go when they bend.
    bent = pose.copy()
    bent[7 + 7] = 0.5  # the index finger's middle joint
    towards_palm = located(hand, bent)[0]["index_tip"] - points["index_tip"]
    thumb_side = points["index_proximal"] - points["little_proximal"]
    for name, turn in turns.items():
        assert np.linalg.det(turn) == pytest.approx(1.0)
        if not name.startswith("thumb"):
            up, right = turn[:, 1], turn[:, 0]
            assert up @ towards_palm < -0.8 * np.linalg.norm(towards_palm), name
            # Seen from the back with fingers away, a right hand's thumb is on the left.
            assert np.sign(right @ thumb_side) == (-1.0 if side == "right" else 1.0), name
    # The thumb's nail looks away from where the thumb bends to.
    bent = pose.copy()
    bent[7 + 4] = 0.5
    towards_pad = located(hand, bent)[0]["thumb_tip"] - points["thumb_tip"]
    assert turns["thumb_distal"][:, 1] @ towards_pad < 0.0


def test_a_bent_finger_keeps_its_up_at_its_nail(side: Side) -> None:
    hand = HandModel.load().shaped(side=side)
    pose = flat_pose()
    pose[7 + 5], pose[7 + 7] = 1.0, 0.5
    _, turns = located(hand, pose)
    _, flat = located(hand, flat_pose())
    angle = Rotation.from_matrix(flat["index_tip"].T @ turns["index_tip"]).as_rotvec()
    # Bending turns forward away from up: about -x of the joint, for both hands.
    np.testing.assert_allclose(angle, [-1.5, 0.0, 0.0], atol=1e-6)


def test_metacarpals_have_human_lengths_and_lie_in_the_flesh(track: Track) -> None:
    pose = flat_pose()
    points, _ = located(track.hand, pose)
    for finger, ratio in zip(
        ("index", "middle", "ring", "little"), METACARPAL_TO_PROXIMAL, strict=True
    ):
        metacarpal = points[f"{finger}_proximal"] - points[f"{finger}_metacarpal"]
        proximal = points[f"{finger}_intermediate"] - points[f"{finger}_proximal"]
        assert np.linalg.norm(metacarpal) / np.linalg.norm(proximal) == pytest.approx(ratio)
    inside = np.array([points[name] for name in ("palm", *(f"{f}_metacarpal" for f in FINGERS))])
    winding = winding_numbers(skin(track.hand, pose), track.hand.faces, inside)
    np.testing.assert_allclose(winding, 1.0, atol=1e-6)
    middle = 0.5 * (points["middle_metacarpal"] + points["middle_proximal"])
    np.testing.assert_allclose(points["palm"], middle, atol=1e-12)


def test_radii_reach_the_skin(track: Track) -> None:
    rest = flat_pose()
    rest[7:] = track.hand.rest_angles
    joints = JointSet.of(track.hand)
    points, _ = joints.located(track.hand, rest)
    mesh = trimesh.Trimesh(skin(track.hand, rest), track.hand.faces, process=False)
    _, distances, _ = trimesh.proximity.closest_point_naive(mesh, points)
    np.testing.assert_allclose(joints.radii, distances, atol=1e-5)
    assert 1e3 * joints.radii.max() < 25.0
    np.testing.assert_allclose(
        points[[JOINTS.index(name) for name in KEYPOINT_JOINTS]],
        keypoints(track.hand, rest),
        atol=1e-12,
    )
