"""BVH: skeleton and motion for animation programs, in centimetres and degrees, y up.

With all angles 0 the hand lies flat, its palm frame along the axes. A BVH joint knows no rotation
of its own at rest, so a bone's frame is turned into the palm's axes of that flat hand: with C_b the
zero-angle rotation of bone b in the palm frame, joint b turns by C_parent R_parent_b C_b^T.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtrack.export.axes import points_y_up, rotations_in_parents, rotations_y_up
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand, skeleton_frames
from handtrack.hand.skeleton import BONE_PARENTS, BONES, DISTAL_BONES, NANGLE, NBONE

Float = NDArray[np.float64]

UNIT = 0.01
"""Length of one unit in the file [m]."""

_POSITION = "Xposition Yposition Zposition"
_ROTATION = "Zrotation Yrotation Xrotation"


def bvh(track: Track) -> bytes:
    """Every frame at the mean frame rate; where the hand was not followed, it stands still.

    Raises:
        InputError: No frame was followed.
    """
    poses, flat = track.held_poses(), _flat(track.hand)
    lines = ["HIERARCHY", *_hierarchy(track.hand, flat), "MOTION", f"Frames: {len(track)}"]
    lines.append(f"Frame Time: {track.interval:.9f}")
    motion = _motion(track.hand, flat, poses)
    lines += [" ".join(f"{number:.6f}" for number in row) for row in motion]
    return ("\n".join(lines) + "\n").encode("ascii")


def _flat(hand: ShapedHand) -> Float:
    """C_b: rotations of the bones in the palm frame with all angles 0, shape (16, 3, 3)."""
    rotations, _ = skeleton_frames(
        hand.bone_rotations, hand.bone_origins, hand.angle_axes, np.zeros(NANGLE)
    )
    return rotations


def _hierarchy(hand: ShapedHand, flat: Float, bone: int = 0, indent: str = "") -> list[str]:
    """Lines of one bone and everything below it."""
    parent = BONE_PARENTS[bone]
    inner = indent + "  "
    offset = flat[parent] @ hand.bone_origins[bone] if parent >= 0 else np.zeros(3)
    channels = f"6 {_POSITION} {_ROTATION}" if parent < 0 else f"3 {_ROTATION}"
    lines = [
        f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {BONES[bone]}",
        f"{indent}{{",
        f"{inner}{_offset(offset)}",
        f"{inner}CHANNELS {channels}",
    ]
    for child, its_parent in enumerate(BONE_PARENTS):
        if its_parent == bone:
            lines += _hierarchy(hand, flat, child, inner)
    if bone in DISTAL_BONES:
        tip = flat[bone] @ hand.tip_offsets[DISTAL_BONES.index(bone)]
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}  {_offset(tip)}", f"{inner}}}"]
    return [*lines, f"{indent}}}"]


def _offset(offset: Float) -> str:
    return "OFFSET " + " ".join(f"{number / UNIT:.6f}" for number in offset)


def _motion(hand: ShapedHand, flat: Float, poses: Float) -> Float:
    """Channels of every frame: position, then Euler angles bone by bone, shape (n, 51)."""
    rotations, _ = bone_frames(hand, poses)
    local = rotations_in_parents(rotations_y_up(rotations @ np.swapaxes(flat, -1, -2)))
    with warnings.catch_warnings():
        # Of the angles that gimbal lock leaves open any will do.
        warnings.filterwarnings("ignore", "Gimbal lock", UserWarning)
        angles = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_euler("ZYX")
    angles = np.unwrap(angles.reshape(len(poses), NBONE, 3), axis=0)
    # Bones are numbered as the hierarchy lists them: each chain from the palm outward.
    turns = np.rad2deg(angles).reshape(len(poses), -1)
    return np.concatenate([points_y_up(poses[:, :3]) / UNIT, turns], axis=1)
