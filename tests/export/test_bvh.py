"""The .bvh, read by a parser written here from the published format, and by bvhio."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtrack.export.bvh import bvh
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.hand.skeleton import BONE_PARENTS, BONES, KEYPOINT_BONES, TIP_KEYPOINTS

Float = NDArray[np.float64]

UPRIGHT = np.array([1.0, -1.0, -1.0])


@dataclass
class Joint:
    """A joint of the file, and the node's end site if it has one."""

    name: str
    offset: Float = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)
    children: list[Joint] = field(default_factory=list)


def parse(text: str) -> tuple[Joint, float, Float]:
    """Hierarchy, frame time, numbers of all frames."""
    head, motion = text.split("MOTION\n")
    words = head.split()
    assert words[:2] == ["HIERARCHY", "ROOT"]
    root: Joint | None = None
    stack: list[Joint] = []
    k = 1
    while k < len(words):
        word = words[k]
        if word in ("ROOT", "JOINT", "End"):
            joint = Joint(words[k + 1])
            if stack:
                stack[-1].children.append(joint)
            root = root or joint
            assert words[k + 2] == "{"
            stack.append(joint)
            k += 3
        elif word == "OFFSET":
            stack[-1].offset = np.array([float(x) for x in words[k + 1 : k + 4]])
            k += 4
        elif word == "CHANNELS":
            count = int(words[k + 1])
            stack[-1].channels = words[k + 2 : k + 2 + count]
            k += 2 + count
        else:
            assert word == "}", word
            stack.pop()
            k += 1
    assert root is not None and not stack
    lines = motion.splitlines()
    count = int(re.fullmatch(r"Frames: (\d+)", lines[0])[1])  # type: ignore[index]
    time = float(re.fullmatch(r"Frame Time: ([0-9.]+)", lines[1])[1])  # type: ignore[index]
    numbers = np.array([[float(x) for x in line.split()] for line in lines[2:]])
    assert len(numbers) == count
    return root, time, numbers


def pose(root: Joint, numbers: Float) -> dict[str, tuple[Float, Float]]:
    """Rotation and place of every joint in one frame; end sites under "name end"."""
    out: dict[str, tuple[Float, Float]] = {}
    left = list(numbers)

    def visit(joint: Joint, turn: Float, place: Float, name: str) -> None:
        place = place + turn @ joint.offset
        for channel in joint.channels:
            value, axis = left.pop(0), "XYZ".index(channel[0])
            if channel.endswith("position"):
                place = place + value * np.eye(3)[axis]
            else:
                turn = turn @ Rotation.from_rotvec(np.deg2rad(value) * np.eye(3)[axis]).as_matrix()
        out[name] = turn, place
        for child in joint.children:
            visit(child, turn, place, f"{name} end" if child.name == "Site" else child.name)

    visit(root, np.eye(3), np.zeros(3), root.name)
    assert not left
    return out


@pytest.fixture(scope="module")
def text(track: Track) -> str:
    return bvh(track).decode("ascii")


def test_keypoints_follow_by_forward_kinematics(text: str, track: Track) -> None:
    root, time, numbers = parse(text)
    assert time == pytest.approx(track.interval, abs=1e-8)
    for row, held in zip(numbers, track.held_poses(), strict=True):
        found = pose(root, row)
        points = keypoints(track.hand, held) * UPRIGHT
        for place, bone in enumerate(KEYPOINT_BONES):
            name = BONES[bone] + (" end" if place in TIP_KEYPOINTS else "")
            error_mm = 10.0 * np.linalg.norm(found[name][1] - 100.0 * points[place])
            assert error_mm < 0.01, name


def test_bones_turn_as_those_of_the_hand(text: str, track: Track) -> None:
    root, _, numbers = parse(text)
    first = pose(root, numbers[2])
    rotations, _ = bone_frames(track.hand, track.held_poses())
    upright = UPRIGHT[:, None] * rotations
    for place, row in enumerate(numbers):
        found = pose(root, row)
        for bone, name in enumerate(BONES):
            # From frame 2 to this one, so that the joint's frame at rest does not matter.
            turn = found[name][0] @ first[name][0].T
            expected = upright[place, bone] @ upright[2, bone].T
            error = Rotation.from_matrix(turn.T @ expected).magnitude()
            assert np.rad2deg(error) < 0.01


def test_the_skeleton_at_rest_is_a_flat_hand_of_the_same_bones(text: str, track: Track) -> None:
    root, _, numbers = parse(text)
    found = pose(root, np.zeros(numbers.shape[1]))
    for bone, parent in enumerate(BONE_PARENTS):
        if parent >= 0:
            length = np.linalg.norm(found[BONES[bone]][1] - found[BONES[parent]][1])
            expected = 100.0 * np.linalg.norm(track.hand.bone_origins[bone])
            assert length == pytest.approx(expected, abs=1e-4)
    for finger in ("index", "middle", "ring", "little"):
        joints = np.array(
            [found[f"{finger}_{part}"][1] for part in ("proximal", "middle", "distal")]
        )
        steps = np.diff(joints, axis=0)
        assert (steps[:, 0] > 0.9 * np.linalg.norm(steps, axis=1)).all()
        assert np.linalg.norm(np.cross(*steps)) < 1e-4


def test_gimbal_lock_is_written_exactly_and_silently(track: Track) -> None:
    poses = track.poses.copy()
    half = np.sqrt(0.5)
    for place in np.flatnonzero(track.followed):
        poses[place, 3:7] = [0.0, half, 0.0, -half] if place % 2 else [half, 0.0, half, 0.0]
    turned = replace(track, poses=poses)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        written = bvh(turned).decode("ascii")
    root, _, numbers = parse(written)
    for row, held in zip(numbers, turned.held_poses(), strict=True):
        points = keypoints(track.hand, held) * UPRIGHT
        assert np.linalg.norm(pose(root, row)["little_distal end"][1] - 100 * points[20]) < 1e-3


def test_another_reader_finds_the_same_joints(text: str, track: Track, tmp_path: Path) -> None:
    bvhio = pytest.importorskip(
        "bvhio", reason="bvhio, which reads .bvh independently, is not installed"
    )
    path = tmp_path / "hand.bvh"
    path.write_text(text)
    root = bvhio.readAsHierarchy(str(path))
    for place, held in enumerate(track.held_poses()):
        root.loadPose(place)
        found = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
        _, origins = bone_frames(track.hand, held)
        for bone, name in enumerate(BONES):
            error_mm = 10.0 * np.linalg.norm(found[name] - 100.0 * origins[bone] * UPRIGHT)
            assert error_mm < 0.1, name
