"""The motion of the self-occlusion test: keyframes of fingers, thumb and palm, joined smoothly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import FINGERS
from handtrack.synthesis.motion import Motion, minimum_jerk
from handtrack.synthesis.viewpoints import R_CAMERA_UPRIGHT
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

Float = NDArray[np.float64]


def fist_motion(case: Mapping[str, Any], hand: ShapedHand) -> Motion:
    """Motion of the keyframes of `benchmarks/selftest.toml`.

    Args:
        case: Content of that file: postures in degrees, and keyframes of the three tracks.
        hand: The hand that moves; it decides where the palm's middle is.

    Raises:
        InputError: A keyframe names no posture, or a joint angle is beyond its limits.
    """
    plan = case["motion"]
    frames = int(plan["frames"])
    fingers = {
        name: np.radians(np.concatenate([posture[f] for f in FINGERS[1:]]))
        for name, posture in case["fingers"].items()
    }
    thumbs = {name: np.radians(posture["angles"]) for name, posture in case["thumb"].items()}
    angles = np.concatenate(
        [_named(plan["thumb"], thumbs, frames), _named(plan["fingers"], fingers, frames)], axis=1
    )
    low, high = hand.limits.T
    if (angles < low - 1e-9).any() or (angles > high + 1e-9).any():
        raise InputError("the postures of the self-occlusion test are beyond the joint limits")

    keys = [key["frame"] for key in plan["palm"]]
    turns = keyframe_track(keys, np.radians([key["turn"] for key in plan["palm"]]), frames)
    places = keyframe_track(keys, [key["place"] for key in plan["palm"]], frames)
    poses = np.zeros((frames, 28))
    poses[:, 3:7] = matrix_to_quat(turned(turns) @ R_CAMERA_UPRIGHT)
    poses[:, 7:] = angles
    poses[:, :3] = places - palm_centre(keypoints(hand, poses))
    return Motion.from_poses(
        poses,
        name="selftest",
        source="keyframes after Hamer, PhD thesis, ETH Zurich, section 4.4.1",
        licence="Apache-2.0",
        frames_per_second=float(plan["frames_per_second"]),
    )


def _named(keys: Sequence[tuple[int, str]], postures: Mapping[str, Float], frames: int) -> Float:
    """A track between named postures, shape (frames, n)."""
    unknown = [name for _, name in keys if name not in postures]
    if unknown:
        raise InputError(f"keyframe posture {unknown[0]!r}: expected {', '.join(postures)}")
    values = np.stack([postures[name] for _, name in keys])
    return keyframe_track([frame for frame, _ in keys], values, frames)


def keyframe_track(keys: Sequence[int], values: ArrayLike, frames: int) -> Float:
    """Values of every frame, between keyframes with least jerk, before and after them at rest.

    Args:
        keys: Keyframes, ascending from 0.
        values: Values there, shape (k, n).
        frames: Number of frames.

    Returns:
        Shape (frames, n).

    Raises:
        InputError: The keyframes do not ascend from 0, or there is only one.
    """
    values = np.asarray(values, np.float64)
    places = np.asarray(keys, np.float64)
    if len(places) < 2 or places[0] != 0 or (np.diff(places) <= 0).any():
        raise InputError(f"keyframes are {list(keys)}: expected ascending numbers from 0")
    time = np.arange(frames, dtype=np.float64)
    after = np.clip(np.searchsorted(places, time, side="right"), 1, len(places) - 1)
    share = minimum_jerk((time - places[after - 1]) / (places[after] - places[after - 1]))
    return values[after - 1] + share[:, None] * (values[after] - values[after - 1])


def turned(turns: Float) -> Float:
    """Rotations about the camera's x, then y, then z, shape (n, 3, 3), of angles [rad], (n, 3)."""
    single = [rotvec_to_matrix(turns[:, [axis]] * np.eye(3)[axis]) for axis in range(3)]
    return single[2] @ single[1] @ single[0]
