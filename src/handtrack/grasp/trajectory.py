"""Reaching, manipulation and releasing: nearest recordings, edited (thesis III.4.2 and III.4.3).

The recording nearest to what is wanted is turned about the vertical to lie as the wanted motion
does, and then edited so that it starts and ends where it should and keeps its second differences
(Laplacian editing, Eq. III.17). While the object is carried the hand stays with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.recording import GraspDatabase
from handtrack.grasp.warping import resampled
from handtrack.hand.skeleton import NANGLE, NQ
from handtrack.transforms import (
    apply_increment,
    matrix_to_quat,
    matrix_to_rotvec,
    moved_poses,
    pose_difference,
    quat_to_matrix,
    rotvec_to_matrix,
)

Float = NDArray[np.float64]

PLACE_SCALE, TURN_SCALE = 0.05, 0.5
"""Differences that count the same in the search for an example: metres, radians."""

STRETCH = (0.6, 2.0)
"""Least and largest change of an example's duration. A way n times as long takes sqrt(n) times."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EditWeights:
    """Weights of Eq. III.17 against a second difference."""

    ends: float = 10.0
    """w_1: first and last frame from where they should be."""
    joins: float = 1.0
    """w_2: change of speed from the frame before and to the frame after. The thesis has 0.01, with
    which, at 120 frames a second, most of a change of speed is left."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A weight is out of range.
        """
        if not (np.isfinite(self.ends) and self.ends > 0):
            raise InputError(f"ends is {self.ends}; expected more than 0")
        if not (np.isfinite(self.joins) and self.joins >= 0):
            raise InputError(f"joins is {self.joins}; expected at least 0")


def edited(
    motion: ArrayLike,
    *,
    first: ArrayLike,
    last: ArrayLike,
    before: ArrayLike | None = None,
    after: ArrayLike | None = None,
    weights: EditWeights | None = None,
) -> Float:
    """A motion that keeps the second differences of an example and has other ends (Eq. III.17).

    Args:
        motion: The example in any linear coordinates, shape (nframe, n), of 3 frames or more.
        first: Where it should start, shape (n,).
        last: Where it should end, shape (n,).
        before: The frame before the first, shape (n,), where there is one.
        after: The frame after the last, shape (n,), where there is one.
        weights: What counts how much.

    Returns:
        Shape (nframe, n).

    Raises:
        InputError: The motion has fewer than three frames, or shapes do not fit.
    """
    weights = weights or EditWeights()
    example = np.asarray(motion, np.float64)
    if example.ndim != 2 or len(example) < 3:
        raise InputError(
            f"a motion to edit has shape {example.shape}; expected (n, m), 3 frames or more"
        )
    count, size = example.shape
    goals = [None if g is None else np.asarray(g, np.float64) for g in (first, last, before, after)]
    for goal in goals:
        if goal is not None and goal.shape != (size,):
            raise InputError(f"an end has shape {goal.shape}; expected ({size},)")
    start, end, earlier, later = goals
    # Unknown is the correction: rows of second differences ask for none.
    rows = np.zeros((count + 2, count))
    wanted = np.zeros((count + 2, size))
    inner = np.arange(count - 2)
    rows[inner, inner], rows[inner, inner + 1], rows[inner, inner + 2] = 1.0, -2.0, 1.0
    ends, joins = np.sqrt(weights.ends), np.sqrt(weights.joins)
    rows[-4, 0], wanted[-4] = ends, ends * (start - example[0])
    rows[-3, -1], wanted[-3] = ends, ends * (end - example[-1])
    for row, at, beside, outer in ((-2, 0, 1, earlier), (-1, -1, -2, later)):
        if outer is not None:
            rows[row, at], rows[row, beside] = -2.0 * joins, joins
            wanted[row] = -joins * (outer + example[beside] - 2.0 * example[at])
    return example + np.linalg.solve(rows.T @ rows, rows.T @ wanted)


def reach(
    database: GraspDatabase,
    grip: str,
    start: ArrayLike | None,
    closing: ArrayLike,
    frame_rate: float,
    *,
    weights: EditWeights | None = None,
) -> Float:
    """The hand's way to where it begins to close.

    Args:
        database: Recordings.
        grip: Grip mode.
        start: Where the hand is, at rest, shape (28,); None: where the example has it.
        closing: The closing motion, z up, shape (m, 28).
        frame_rate: Frames per second wanted.
        weights: Of the editing.

    Returns:
        Hand poses, shape (nframe, 28); the last one is where closing starts.

    Raises:
        InputError: Shapes do not fit, or no recording of the grip mode has a reaching phase.
    """
    close = np.asarray(closing, np.float64)
    if close.ndim != 2 or close.shape[1] != NQ or len(close) < 2:
        raise InputError(f"closing has shape {close.shape}; expected at least 2 poses of 28")
    goal = close[0]
    wanted = None if start is None else _checked_pose(start, NQ, "start")
    phases = [(r, r.of_phase("reaching")) for r in database.of_grip(grip)]
    found = [(r, phase) for r, phase in phases if len(phase) >= 3]
    if not found:
        raise InputError(f"no recording of {grip} has a reaching phase")
    scale = np.concatenate([np.full(3, PLACE_SCALE), np.full(3 + NANGLE, TURN_SCALE)])
    ends = _heading_as(np.array([r.hand_poses[phase[[0, -1]]] for r, phase in found]), -1, goal)
    cost = ((pose_difference(ends[:, -1], goal)[:, 6:] / TURN_SCALE) ** 2).sum(1)
    if wanted is not None:
        way = pose_difference(wanted, goal)
        starts = pose_difference(ends[:, 0], ends[:, -1])
        cost += (((starts - way) / scale) ** 2).sum(1)
    recording, phase = found[int(cost.argmin())]
    chosen = _heading_as(recording.hand_poses[phase], -1, goal)
    example = _unwrapped(pose_difference(chosen, chosen[-1]))
    first = example[0] if wanted is None else _unwrapped(np.stack([example[0], way]))[1]
    stretch = _stretch(first[:3], example[0, :3])
    example = _at_rate(example, recording.frame_rate, frame_rate, stretch)
    motion = edited(
        example, first=first, last=np.zeros(example.shape[1]), before=first,
        after=pose_difference(close[1], goal), weights=weights,
    )  # fmt: skip
    poses = apply_increment(goal, motion)
    poses[-1] = goal
    return poses


def transport(
    database: GraspDatabase,
    start: ArrayLike,
    target: ArrayLike,
    frame_rate: float,
    *,
    weights: EditWeights | None = None,
) -> Float:
    """Path of an object that is carried from one pose to another, at rest at both.

    Args:
        database: Recordings, of any grip mode.
        start: Where the object is: centre [m] and quaternion, z up, shape (7,).
        target: Where it should go, shape (7,).
        frame_rate: Frames per second wanted.
        weights: Of the editing.

    Returns:
        Object poses, shape (nframe, 7), from start to target.

    Raises:
        InputError: Shapes do not fit, or no recording has a manipulation phase.
    """
    first, last = _checked_pose(start, 7, "start"), _checked_pose(target, 7, "target")
    phases = [(r, r.of_phase("manipulation")) for r in database]
    found = [(r, phase) for r, phase in phases if len(phase) >= 3]
    if not found:
        raise InputError("no recording has a manipulation phase")
    way = _moved(last, first)
    # The last frame of the closing phase is where the object starts.
    starts = np.array([r.object_poses[phase[0] - 1] for r, phase in found])
    ends = np.array([r.object_poses[phase[-1]] for r, phase in found])
    off = _along(_moved(ends, starts)[:, None], way)[:, -1] - way
    cost = ((off / np.repeat([PLACE_SCALE, TURN_SCALE], 3)) ** 2).sum(1)
    recording, phase = found[int(cost.argmin())]
    path = recording.object_poses[phase[0] - 1 : phase[-1] + 1]
    example = _along(_moved(path, path[0]), way)
    stretch = _stretch(way[:3], example[-1, :3])
    example = _at_rate(_unwrapped(example, 3), recording.frame_rate, frame_rate, stretch)
    goal = _unwrapped(np.stack([example[-1], way]), 3)[1]
    moved = edited(
        example, first=np.zeros(6), last=goal, before=np.zeros(6), after=goal, weights=weights
    )
    turns = rotvec_to_matrix(moved[:, 3:]) @ quat_to_matrix(first[3:])
    path = np.concatenate([first[:3] + moved[:, :3], matrix_to_quat(turns)], axis=1)
    path[0], path[-1] = first, last
    return path


def carried(hand: ArrayLike, path: ArrayLike) -> Float:
    """Hand poses, shape (n, 28), that stay with an object as it goes.

    Args:
        hand: Hand at the object's first pose, shape (28,).
        path: Poses of the object, shape (n, 7).
    """
    pose = _checked_pose(hand, NQ, "hand")
    objects = np.asarray(path, np.float64)
    turns = quat_to_matrix(objects[:, 3:]) @ quat_to_matrix(objects[0, 3:]).T
    return moved_poses(pose, turns, objects[:, :3] - turns @ objects[0, :3])


def release(database: GraspDatabase, grip: str, hand: ArrayLike, frame_rate: float) -> Float:
    """The hand opens and goes, from where it holds the object.

    Only the start is given, so the example with its least second differences changed is the example
    itself, moved to that start.

    Args:
        database: Recordings.
        grip: Grip mode.
        hand: The hand that holds the object, z up, shape (28,).
        frame_rate: Frames per second wanted.

    Returns:
        Hand poses, shape (nframe, 28); the first one is `hand`.

    Raises:
        InputError: Shapes do not fit, or no recording of the grip mode has a releasing phase.
    """
    pose = _checked_pose(hand, NQ, "hand")
    phases = [(r, r.of_phase("releasing")) for r in database.of_grip(grip)]
    found = [(r, phase) for r, phase in phases if len(phase) >= 3]
    if not found:
        raise InputError(f"no recording of {grip} has a releasing phase")
    # The last frame of the manipulation phase still holds the object.
    holds = _heading_as(np.array([[r.hand_poses[phase[0] - 1]] for r, phase in found]), 0, pose)
    apart = pose_difference(holds[:, 0], pose)[:, 3:]
    recording, phase = found[int((apart**2).sum(1).argmin())]
    motion = _heading_as(recording.hand_poses[phase[0] - 1 : phase[-1] + 1], 0, pose)
    example = _unwrapped(pose_difference(motion, motion[0]))
    # The way back is the palm's own: told in its frame, it leaves along the approach.
    turn = quat_to_matrix(pose[3:7]) @ quat_to_matrix(motion[0, 3:7]).T
    example[:, :3] = example[:, :3] @ turn.T
    return apply_increment(pose, _at_rate(example, recording.frame_rate, frame_rate, 1.0))


def _checked_pose(pose: ArrayLike, size: int, name: str) -> Float:
    found = np.asarray(pose, np.float64)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise InputError(f"{name} has shape {found.shape}; expected {size} finite numbers")
    return found


def _heading_as(poses: Float, frame: int, goal: Float) -> Float:
    """Motions turned about z so that the palm of one frame heads as that of a goal pose.

    Args:
        poses: Shape (..., nframe, 28).
        frame: Number of that frame.
        goal: Shape (28,).
    """
    turn = quat_to_matrix(goal[3:7]) @ np.swapaxes(quat_to_matrix(poses[..., frame, 3:7]), -1, -2)
    # The nearest turn about z to a turn, in the sense of least squares.
    yaw = np.arctan2(turn[..., 1, 0] - turn[..., 0, 1], turn[..., 0, 0] + turn[..., 1, 1])
    return moved_poses(poses, _about_z(yaw)[..., None, :, :])


def _about_z(yaw: ArrayLike) -> Float:
    """Rotations about z, shape (..., 3, 3), by angles [rad], shape (...)."""
    return rotvec_to_matrix(np.asarray(yaw, np.float64)[..., None] * np.array([0.0, 0.0, 1.0]))


def _moved(poses: Float, origin: Float) -> Float:
    """Shift [m] and rotation vector [rad] in the world from other poses, shape (..., 6)."""
    turns = quat_to_matrix(poses[..., 3:]) @ np.swapaxes(quat_to_matrix(origin[..., 3:]), -1, -2)
    return np.concatenate([poses[..., :3] - origin[..., :3], matrix_to_rotvec(turns)], axis=-1)


def _along(moved: Float, way: Float) -> Float:
    """Motions (..., nframe, 6) turned about z so that their ways point where another does."""
    last = moved[..., -1, :]
    yaw = np.arctan2(way[1], way[0]) - np.arctan2(last[..., 1], last[..., 0])
    back = np.swapaxes(_about_z(yaw), -1, -2)
    return np.concatenate([moved[..., :3] @ back, moved[..., 3:] @ back], axis=-1)


def _unwrapped(motion: Float, first: int = 3) -> Float:
    """A motion whose rotation vectors, at columns `first` to `first` + 3, make no jumps."""
    out = motion.copy()
    for k in range(1, len(out)):
        vector = out[k, first : first + 3]
        angle = float(np.linalg.norm(vector))
        if angle > 1e-9:
            # The same turn the other way round.
            other = vector * (1.0 - 2.0 * np.pi / angle)
            near = out[k - 1, first : first + 3]
            if np.linalg.norm(other - near) < np.linalg.norm(vector - near):
                out[k, first : first + 3] = other
    return out


def _stretch(way: Float, example: Float) -> float:
    """How many times as long a way takes as an example's."""
    ratio = float(np.linalg.norm(way)) / max(float(np.linalg.norm(example)), 1e-3)
    return float(np.clip(np.sqrt(ratio), *STRETCH))


def _at_rate(motion: Float, rate: float, wanted: float, stretch: float) -> Float:
    """A motion of `rate` frames a second, made longer by `stretch`, at another rate, (n, m)."""
    if not (np.isfinite(wanted) and wanted > 0):
        raise InputError(f"frame_rate is {wanted}; expected more than 0")
    count = max(round((len(motion) - 1) / rate * stretch * wanted) + 1, 3)
    return resampled(motion, np.linspace(0.0, len(motion) - 1.0, count))
