"""Animated glTF: the skinned hand and its motion in one .glb file, in metres, y up.

Nodes: `camera`, which turns the camera frame upright and may be given the camera's place in a
scene; below it the 16 bones, whose numbers are those of the hand model and the pose, and the five
tips.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack import __version__
from handtrack.export.axes import continuous_quats, rotations_in_parents, xyzw
from handtrack.export.glb import TRIANGLES, VERTICES, Buffer
from handtrack.export.skin_binding import bind
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand, vertex_normals
from handtrack.hand.skeleton import (
    BONE_PARENTS,
    BONES,
    DISTAL_BONES,
    KEYPOINTS,
    NBONE,
    TIP_KEYPOINTS,
)
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

_CAMERA = 0
_FIRST_BONE = 1
_FIRST_TIP = _FIRST_BONE + NBONE
_MESH = _FIRST_TIP + len(DISTAL_BONES)
"""Indices of nodes."""

_SKIN_COLOUR = (0.76, 0.57, 0.47, 1.0)
"""Linear red, green, blue, alpha."""


def gltf(track: Track) -> bytes:
    """Every frame as a key at its time; where the hand was not followed, it stands still.

    A frame that is not later than the one before it has no key.

    Raises:
        InputError: No frame was followed.
    """
    poses = track.held_poses()
    times = (track.times - track.times[0]).astype(np.float32)
    later = np.r_[True, times[1:] > np.maximum.accumulate(times)[:-1]]
    poses, times = poses[later], times[later]
    quats = continuous_quats(_local_quats(track.hand, poses))

    buffer = Buffer()
    mesh, skin = _mesh(track.hand, buffer)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"handtrack {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [_CAMERA, _MESH]}],
        "nodes": _nodes(track.hand, poses[0], quats[0]),
        "meshes": [mesh],
        "skins": [skin],
        "materials": [{
            "name": "skin",
            "pbrMetallicRoughness": {
                "baseColorFactor": _SKIN_COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.7,
            },
        }],
        "animations": [_animation(times, poses, quats, buffer)],
        "extras": {
            "source": track.source,
            "side": track.side,
            "first_time": float(track.times[0]),
            "frames": track.frames[later].tolist(),
            "states": [track.states[place].value for place in np.flatnonzero(later)],
        },
    }  # fmt: skip
    return buffer.glb(document)


def _local_quats(hand: ShapedHand, poses: Float) -> Float:
    """Rotation of each bone in its parent, the palm's in the camera; w x y z, shape (n, 16, 4)."""
    rotations, _ = bone_frames(hand, poses)
    return matrix_to_quat(rotations_in_parents(rotations))


def _nodes(hand: ShapedHand, pose: Float, quats: Float) -> list[dict[str, Any]]:
    """Camera, bones in the first frame's pose, tips, mesh."""
    nodes: list[dict[str, Any]] = [
        {"name": "camera", "rotation": [1.0, 0.0, 0.0, 0.0], "children": [_FIRST_BONE]}
    ]
    for bone, name in enumerate(BONES):
        children = [_FIRST_BONE + k for k, parent in enumerate(BONE_PARENTS) if parent == bone]
        if bone in DISTAL_BONES:
            children = [_FIRST_TIP + DISTAL_BONES.index(bone)]
        origin = pose[:3] if bone == 0 else hand.bone_origins[bone]
        nodes.append({
            "name": name, "translation": origin.tolist(), "rotation": xyzw(quats[bone]).tolist(),
            "children": children,
        })  # fmt: skip
    for tip, offset in zip(TIP_KEYPOINTS, hand.tip_offsets, strict=True):
        nodes.append({"name": KEYPOINTS[tip], "translation": offset.tolist()})
    return [*nodes, {"name": f"{hand.side} hand", "mesh": 0, "skin": 0}]


def _mesh(hand: ShapedHand, buffer: Buffer) -> tuple[dict[str, Any], dict[str, Any]]:
    """The skinned mesh and the skin that moves it."""
    rest, matrices = bind(hand)
    joints = np.zeros((hand.nvert, 4), np.uint8)
    weights = np.zeros((hand.nvert, 4), np.float32)
    # A joint that does not move the vertex is to be number 0.
    joints[:, :3] = np.where(hand.weights > 0.0, hand.weight_bones, 0)
    weights[:, :3] = hand.weights
    attributes = {
        "POSITION": buffer.add(rest.astype(np.float32), target=VERTICES),
        "NORMAL": buffer.add(
            vertex_normals(rest, hand.faces).astype(np.float32), target=VERTICES
        ),
        "JOINTS_0": buffer.add(joints, target=VERTICES),
        "WEIGHTS_0": buffer.add(weights, target=VERTICES),
    }  # fmt: skip
    triangles = buffer.add(hand.faces.astype(np.uint32).ravel(), target=TRIANGLES)
    mesh = {
        "name": f"{hand.side} hand",
        "primitives": [{"attributes": attributes, "indices": triangles, "material": 0}],
    }
    skin = {
        "joints": list(range(_FIRST_BONE, _FIRST_BONE + NBONE)),
        "skeleton": _FIRST_BONE,
        "inverseBindMatrices": buffer.add(matrices.astype(np.float32)),
    }
    return mesh, skin


def _animation(
    times: NDArray[np.float32], poses: Float, quats: Float, buffer: Buffer
) -> dict[str, Any]:
    """Keys of the palm's translation and of every bone's rotation."""
    clock = buffer.add(times)
    outputs = [buffer.add(poses[:, :3].astype(np.float32))]
    outputs += [buffer.add(xyzw(quats[:, bone]).astype(np.float32)) for bone in range(NBONE)]
    targets = [
        {"node": _FIRST_BONE, "path": "translation"},
        *({"node": _FIRST_BONE + bone, "path": "rotation"} for bone in range(NBONE)),
    ]
    return {
        "name": "tracked",
        "samplers": [
            {"input": clock, "output": output, "interpolation": "LINEAR"} for output in outputs
        ],
        "channels": [
            {"sampler": sampler, "target": target} for sampler, target in enumerate(targets)
        ],
    }
