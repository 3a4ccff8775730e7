"""OpenXR: the 26 hand joints of XR_EXT_hand_tracking, one frame per JSON line.

Axes of a joint after the OpenXR specification 1.1, "Conventions of hand joints": -z forward along
the bone to the tip, +y up out of the back of the hand, +x by the right-hand rule, on both hands. A
bone frame of ours has x forward and y out of the palm, so only the names change. The metacarpals of
the fingers, which move with the palm here, are laid into it by their measured proportions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.export.axes import points_y_up, rotations_y_up, xyzw
from handtrack.export.frame_document import rounded, to_json
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import BASE_BONES, DISTAL_BONES, FINGERS
from handtrack.hand.surface_distance import surface_distance
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

JOINTS: tuple[str, ...] = (
    "palm", "wrist",
    *(f"thumb_{part}" for part in ("metacarpal", "proximal", "distal", "tip")),
    *(f"{finger}_{part}" for finger in FINGERS[1:]
      for part in ("metacarpal", "proximal", "intermediate", "distal", "tip")),
)  # fmt: skip
"""Joints in the order of XrHandJointEXT, shape (26,)."""

METACARPAL_TO_PROXIMAL = (68.12 / 39.78, 64.60 / 44.63, 58.00 / 41.37, 53.69 / 32.74)
"""Length of each finger's metacarpal over that of its proximal phalanx: means of Buryanov & Kotiuk
(2010), "Proportions of hand segments", Int. J. Morphol. 28(3):755-758; index to little finger."""

R_BONE_JOINT = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
"""From the axes of an OpenXR joint to those of our bone: forward is x, up is -y, right is -z."""

TRACKED = 0b1111
"""XrSpaceLocationFlags: position and orientation valid and tracked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointSet:
    """Where the 26 joints sit on the bones of one hand; constant while it moves."""

    bones: NDArray[np.intp]
    """Bone that carries each joint, shape (26,)."""
    offsets: Float
    """Place of each joint in the frame of its bone [m], shape (26, 3)."""
    rotations: Float
    """Rotation from each joint to its bone, shape (26, 3, 3)."""
    radii: Float
    """Distance of each joint from the skin in the rest pose [m], shape (26,)."""

    @classmethod
    def of(cls, hand: ShapedHand) -> JointSet:
        """The joints of one person's hand."""
        places: list[tuple[int, Float, Float]] = []
        origin, aligned = np.zeros(3), np.eye(3)
        lengths = hand.bone_lengths
        for finger, base in enumerate(BASE_BONES):
            if finger:
                turn, knuckle = hand.bone_rotations[base], hand.bone_origins[base]
                metacarpal = METACARPAL_TO_PROXIMAL[finger - 1] * lengths[base]
                places.append((0, knuckle - metacarpal * turn[:, 0], turn))
            places += [(bone, origin, aligned) for bone in range(base, base + 3)]
            places.append((DISTAL_BONES[finger], hand.tip_offsets[finger], aligned))
        knuckle = BASE_BONES[2]
        _, start, turn = places[4 + 5]
        palm = 0.5 * (start + hand.bone_origins[knuckle])
        places = [(0, palm, turn), (0, origin, aligned), *places]

        joints = cls(
            bones=np.array([bone for bone, _, _ in places], np.intp),
            offsets=np.array([offset for _, offset, _ in places]),
            rotations=np.array([turn @ R_BONE_JOINT for _, _, turn in places]),
            radii=np.zeros(len(places)),
        )
        rest = np.concatenate([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], hand.rest_angles])
        points, _ = joints.located(hand, rest)
        radii = surface_distance(points, skin(hand, rest), hand.faces)
        return replace(joints, radii=radii)

    def located(self, hand: ShapedHand, pose: Float) -> tuple[Float, Float]:
        """Positions [m], shape (..., 26, 3), and rotations R_camera_joint, shape (..., 26, 3, 3).

        Args:
            hand: The hand they were made for.
            pose: Poses, shape (..., 28).
        """
        rotations, origins = bone_frames(hand, pose)
        turned = rotations[..., self.bones, :, :]
        points = (turned @ self.offsets[..., None])[..., 0] + origins[..., self.bones, :]
        return points, turned @ self.rotations


def openxr(track: Track) -> bytes:
    """Every frame; where the hand was not followed, it is not active and has no joints."""
    joints = JointSet.of(track.hand)
    points, rotations = joints.located(track.hand, track.poses)
    followed = track.followed
    positions = points_y_up(track.at_size(points))
    quats = np.full((*positions.shape[:-1], 4), np.nan)
    quats[followed] = xyzw(matrix_to_quat(rotations_y_up(rotations[followed])))
    radii = track.sizes[:, None] * joints.radii
    lines = []
    for place, active in enumerate(followed):
        located = positions[place], quats[place], radii[place]
        document = {
            "frame": int(track.frames[place]),
            "time": float(track.times[place]),
            "hand": f"XR_HAND_{track.side.upper()}_EXT",
            "isActive": bool(active),
            "jointLocations": _locations(*located) if active else [],
        }
        lines.append(to_json(document))
    return ("\n".join(lines) + "\n").encode("ascii")


def _locations(positions: Float, quats: Float, radii: Float) -> list[dict[str, Any]]:
    """XrHandJointLocationEXT of each joint."""
    return [
        {
            "locationFlags": TRACKED,
            "pose": {"orientation": _named("xyzw", quat), "position": _named("xyz", position)},
            "radius": radius,
        }
        for position, quat, radius in zip(positions, quats, rounded(radii), strict=True)
    ]


def _named(names: str, values: Float) -> dict[str, float]:
    return dict(zip(names, rounded(values), strict=True))
