"""Names and topology of the skeleton fit together."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.hand import skeleton
from oracles.hand_formulas import BASES, BONE_ANGLES, PARENTS, TIPS


def test_sizes_are_those_of_the_thesis() -> None:
    assert (skeleton.NBONE, skeleton.NANGLE, skeleton.NKEYPOINT) == (16, 21, 21)
    assert (skeleton.NQ, skeleton.NV) == (28, 27)
    assert len(skeleton.POSE) == 28
    assert skeleton.POSE[:7] == ("tx", "ty", "tz", "qw", "qx", "qy", "qz")


@pytest.mark.parametrize("names", ["BONES", "ANGLES", "KEYPOINTS", "POSE", "FINGERS"])
def test_names_are_unique(names: str) -> None:
    values = getattr(skeleton, names)
    assert len(set(values)) == len(values)


def test_topology_is_that_of_the_independent_table() -> None:
    assert list(skeleton.BONE_PARENTS) == PARENTS
    assert list(skeleton.BASE_BONES) == BASES
    assert list(skeleton.DISTAL_BONES) == TIPS
    moved = [skeleton.ANGLE_BONES.index(b) if b in skeleton.ANGLE_BONES else -1 for b in range(16)]
    assert [angles[0] if angles else -1 for angles in BONE_ANGLES] == moved


def test_parents_come_before_children() -> None:
    assert all(parent < bone for bone, parent in enumerate(skeleton.BONE_PARENTS))


def test_every_angle_moves_a_bone_of_its_own_finger() -> None:
    for name, bone in zip(skeleton.ANGLES, skeleton.ANGLE_BONES, strict=True):
        finger = name.split("_")[0]
        assert skeleton.BONES[bone].startswith(finger)
        assert skeleton.FINGERS[skeleton.finger_of_bone(bone)] == finger
    assert skeleton.finger_of_bone(0) == -1


def test_every_keypoint_sits_on_its_finger() -> None:
    for index, (name, bone) in enumerate(
        zip(skeleton.KEYPOINTS, skeleton.KEYPOINT_BONES, strict=True)
    ):
        if name == "wrist":
            assert bone == 0
        else:
            assert skeleton.BONES[bone].startswith(name.split("_")[0])
        assert (index in skeleton.TIP_KEYPOINTS) == name.endswith("_tip")


def test_keypoints_are_in_the_order_of_mediapipe() -> None:
    assert skeleton.KEYPOINTS[0] == "wrist"
    assert skeleton.KEYPOINTS[1:5] == ("thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip")
    assert skeleton.KEYPOINTS[5:9] == ("index_mcp", "index_pip", "index_dip", "index_tip")
    assert skeleton.KEYPOINTS[20] == "little_tip"
    np.testing.assert_array_equal(skeleton.TIP_KEYPOINTS, [4, 8, 12, 16, 20])
