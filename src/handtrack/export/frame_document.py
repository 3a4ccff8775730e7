"""One frame as a JSON document: a line of the jsonl export and a message of the publisher.

docs/publish.md describes it, docs/frame.schema.json is its JSON schema.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, NBONE
from handtrack.tracking.result import HandResult, TrackState
from handtrack.transforms import matrix_to_quat

FORMAT = "handtrack-frame"
"""What the document calls itself."""

VERSION = 1
"""Version of the layout: raised when a reader of the old one would misread the new one."""

_DIGITS = 7
"""Decimals of metres, radians and quaternions."""

Float = NDArray[np.float64]


def frame_document(
    *,
    frame: int,
    time: float,
    side: str,
    state: TrackState,
    problem: str | None,
    depth_error: float,
    pose: Float,
    keypoints: NDArray[np.floating[Any]],
    keypoint_std: NDArray[np.floating[Any]],
    bone_quats: Float,
) -> dict[str, Any]:
    """What is known of the hand in one frame, ready for JSON; null is what is not known.

    Args:
        frame: Number of the frame in its sequence.
        time: Its time stamp [s].
        side: "right" or "left".
        state: How far the pose can be trusted.
        problem: What was wrong with the frame; None or empty for nothing.
        depth_error: E_d [m].
        pose: Pose vector, shape (28,); NaN with NO_HAND.
        keypoints: Keypoints [m], camera frame, shape (21, 3).
        keypoint_std: One sigma of each [m], shape (21,).
        bone_quats: Orientation of each bone in the camera frame, w x y z, shape (16, 4); NaN with
            NO_HAND.
    """
    known = state is not TrackState.NO_HAND
    return {
        "format": FORMAT,
        "version": VERSION,
        "frame": int(frame),
        "time": float(time),
        "side": side,
        "state": state.value,
        "problem": problem or None,
        "depth_error": _number(depth_error),
        "translation": rounded(pose[:3]) if known else None,
        "orientation": rounded(pose[3:7]) if known else None,
        "angles": dict(zip(ANGLES, rounded(pose[7:]), strict=True)) if known else None,
        "keypoints": [rounded(point) for point in keypoints] if known else None,
        "keypoint_std": rounded(keypoint_std) if np.isfinite(keypoint_std).all() else None,
        "bone_orientations": [rounded(quat) for quat in bone_quats] if known else None,
    }


def result_document(frame: int, time: float, hand: HandResult) -> dict[str, Any]:
    """A tracker's result as a document.

    Args:
        frame: Number of the frame.
        time: Its time stamp [s].
        hand: What the tracker said about it.
    """
    return frame_document(
        frame=frame,
        time=time,
        side=hand.side,
        state=hand.state,
        problem=hand.problem,
        depth_error=hand.depth_error,
        pose=hand.pose,
        keypoints=hand.keypoints,
        keypoint_std=hand.keypoint_std,
        bone_quats=bone_quats(hand.hand, hand.pose),
    )


def bone_quats(hand: ShapedHand, poses: Float) -> Float:
    """Orientations of the bones in the camera frame, w x y z, shape (..., 16, 4).

    Args:
        hand: One person's hand.
        poses: Poses, shape (..., 28); a pose of NaN gives NaN.
    """
    known = np.isfinite(poses).all(axis=-1)
    quats = np.full((*known.shape, NBONE, 4), np.nan)
    if known.any():
        quats[known] = matrix_to_quat(bone_frames(hand, poses[known])[0])
    return quats


def to_json(document: dict[str, Any]) -> str:
    """The document on one line; NaN, which JSON does not know, is an error."""
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def rounded(values: Iterable[float]) -> list[float]:
    """Metres, radians or entries of quaternions, to so many decimals as documents hold."""
    return [round(float(value), _DIGITS) for value in values]


def _number(value: float) -> float | None:
    return round(float(value), _DIGITS) if math.isfinite(value) else None
