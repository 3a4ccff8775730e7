"""Where a recorded sequence's first pose comes from: a file, or the labels of its first frame."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.skeleton import NQ

if TYPE_CHECKING:
    from handtrack.camera.frame import DepthFrame, FrameTruth
    from handtrack.camera.sequence import Sequence
    from handtrack.hand.model import HandModel, ShapedHand

Pose = NDArray[np.float64]

MIN_JOINTS = 6
"""So many joints must be labelled for inverse kinematics."""


def read_pose(path: Path) -> Pose:
    """A pose, shape (28,), from a file.

    Args:
        path: .json with a list of 28 numbers, or an object that has it under "pose"; .npz with the
            array "pose", shape (28,) or (n, 28), whose first is taken (so results.npz works).

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It cannot be read.
        InputError: It holds no pose.
    """
    if not path.is_file():
        raise MissingFileError(f"no first pose at {path}: expected a .json or .npz file")
    content: Any
    try:
        if path.suffix.lower() == ".json":
            content = json.loads(path.read_text(encoding="utf-8"))
            content = content.get("pose") if isinstance(content, dict) else content
        else:
            with np.load(path, allow_pickle=False) as data:
                content = data["pose"] if "pose" in data.files else None
    except (ValueError, OSError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise DamagedFileError(f"{path} cannot be read as a pose: {error}") from error
    try:
        pose = np.asarray(content, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.ndim == 2 and len(pose):
        pose = pose[0]
    if pose.shape != (NQ,) or not np.isfinite(pose).all():
        raise InputError(
            f"{path} holds no pose: expected 28 finite numbers (translation [m] 3, quaternion "
            "w x y z, joint angles [rad] 21) under 'pose'"
        )
    return pose


def first_labelled(sequence: Sequence) -> DepthFrame | None:
    """First frame whose labels tell a pose, None without one."""
    if not sequence.truth:
        return None
    return next((frame for frame in sequence if tells_pose(frame.truth)), None)


def labelled_pose(truth: FrameTruth, hand: ShapedHand, model: HandModel) -> Pose:
    """Pose, shape (28,), of the labels of a frame that `first_labelled` found.

    Labels that are a pose are taken as they are; keypoints, and the joints of NYU, go through
    inverse kinematics.

    Args:
        truth: Labels of the frame.
        hand: The hand to be tracked.
        model: Its model.
    """
    if _finite(truth.pose):
        return np.array(truth.pose, np.float64)
    if truth.keypoints is not None and _finite(truth.keypoints):
        from handtrack.hand.inverse_kinematics import BonePoints, initial_pose, solve_poses

        targets = truth.keypoints[None].astype(np.float64)
        points = BonePoints.of_keypoints(hand)
        return solve_poses(hand, points, targets, initial_pose(hand, targets))[0]
    assert truth.joints is not None
    from handtrack.evaluation.nyu import start_pose_from_joints

    return start_pose_from_joints(model, truth.joints, side=hand.side)[0]


def labelled_scale(truth: FrameTruth, model: HandModel, side: str) -> float:
    """Overall scale of the mean hand that suits labelled joints; 1 where labels do not tell."""
    if _finite(truth.pose) or _finite(truth.keypoints) or truth.joints is None:
        return 1.0
    from handtrack.evaluation.nyu import start_pose_from_joints

    return start_pose_from_joints(model, truth.joints, side=side)[1]


def tells_pose(truth: FrameTruth | None) -> bool:
    """Whether a frame's labels are enough for a pose."""
    if truth is None:
        return False
    joints = truth.joints if truth.joint_set == "nyu36" else None
    enough = joints is not None and np.isfinite(joints).all(axis=1).sum() >= MIN_JOINTS
    return enough or _finite(truth.pose) or _finite(truth.keypoints)


def _finite(values: NDArray[Any] | None) -> bool:
    """Whether there are values and all are finite."""
    return values is not None and bool(np.isfinite(values).all())
