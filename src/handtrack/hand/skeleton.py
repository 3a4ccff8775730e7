"""The hand's skeleton: 16 bones moved by 27 degrees of freedom (thesis II.3.1), and all names.

Only names, order and topology live here; lengths, axes and limits belong to `HandModel`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FINGERS: tuple[str, ...] = ("thumb", "index", "middle", "ring", "little")
"""Finger names in the order of keypoints, bones and angles."""

BONES: tuple[str, ...] = (
    "palm",
    "thumb_metacarpal", "thumb_proximal", "thumb_distal",
    *(f"{f}_{b}" for f in FINGERS[1:] for b in ("proximal", "middle", "distal")),
)  # fmt: skip
"""Bone names, shape (16,)."""

BONE_PARENTS: tuple[int, ...] = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
"""Index of each bone's parent, -1 for the palm."""

ANGLES: tuple[str, ...] = (
    "thumb_tm_flexion", "thumb_tm_abduction",
    "thumb_mcp_flexion", "thumb_mcp_abduction", "thumb_ip_flexion",
    *(f"{f}_{a}" for f in FINGERS[1:]
      for a in ("mcp_flexion", "mcp_abduction", "pip_flexion", "dip_flexion")),
)  # fmt: skip
"""Joint angle names, shape (21,): pose[7:28] and increment[6:27]."""

ANGLE_BONES: tuple[int, ...] = (
    1,
    1,
    2,
    2,
    3,
    4,
    4,
    5,
    6,
    7,
    7,
    8,
    9,
    10,
    10,
    11,
    12,
    13,
    13,
    14,
    15,
)
"""Bone that each joint angle moves."""

KEYPOINTS: tuple[str, ...] = (
    "wrist", "thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip",
    *(f"{f}_{k}" for f in FINGERS[1:] for k in ("mcp", "pip", "dip", "tip")),
)  # fmt: skip
"""Keypoint names in the order MediaPipe and OpenPose use, shape (21,)."""

POSE: tuple[str, ...] = ("tx", "ty", "tz", "qw", "qx", "qy", "qz", *ANGLES)
"""Names of the pose vector's entries, shape (28,); also the MuJoCo qpos of the hand."""

NBONE, NANGLE, NKEYPOINT = len(BONES), len(ANGLES), len(KEYPOINTS)
NQ, NV = 7 + NANGLE, 6 + NANGLE
"""Sizes of the pose vector (28) and of its increment (27)."""

BASE_BONES: tuple[int, ...] = (1, 4, 7, 10, 13)
"""First bone of each finger chain."""

DISTAL_BONES: tuple[int, ...] = (3, 6, 9, 12, 15)
"""Last bone of each finger chain."""

KEYPOINT_BONES = np.array([0, 1, 2, 3, 3, 4, 5, 6, 6, 7, 8, 9, 9, 10, 11, 12, 12, 13, 14, 15, 15])
"""Bone on which each keypoint sits: at its origin, except the tips (distal bone + tip offset)."""

PALM_CORNERS: tuple[int, ...] = (0, 5, 9, 13, 17)
"""Indices of the wrist and the four knuckles among the keypoints; the palm moves them as one."""

TIP_KEYPOINTS: tuple[int, ...] = (4, 8, 12, 16, 20)
"""Indices of the five fingertips among the keypoints."""


def finger_of_bone(bone: int) -> int:
    """Index into `FINGERS` of a finger bone; -1 for the palm."""
    return (bone - 1) // 3 if bone > 0 else -1


def _bone_angles() -> NDArray[np.int32]:
    angles = np.full((NBONE, 2), -1, np.int32)
    for angle, bone in enumerate(ANGLE_BONES):
        angles[bone, int(angles[bone, 0] >= 0)] = angle
    return angles


BONE_ANGLES = _bone_angles()
"""Joint angles that move each bone against its parent, outermost first, -1 for none, (16, 2)."""
