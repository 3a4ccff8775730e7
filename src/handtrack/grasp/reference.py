"""The reference motion of a grasp at the simulation's rate, with pauses to take hold and to hold.

A plan has some dozens of frames a second; control needs a target, and its velocity, every
millisecond. Two pauses are put in: one between closing and manipulation, in which the fingers take
up the load, and one at the end of manipulation, in which the object must stay where it was brought.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from handtrack.errors import InputError
from handtrack.grasp.phases import phase_numbers
from handtrack.hand.skeleton import NV

Float = NDArray[np.float64]


class Stage(IntEnum):
    """What the hand is at: the phases, and the pauses put between them."""

    REACHING = 0
    CLOSING = 1
    TAKING = 2
    """Closed; the fingers find the object and take up the load."""
    CARRYING = 3
    HOLDING = 4
    """The object stays where it was brought."""
    RELEASING = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Targets of every simulated step."""

    times: Float
    """Time of each step [s], shape (nstep,)."""
    hand_poses: Float
    """Hand in the world, shape (nstep, 28)."""
    hand_velocities: Float
    """Increments per second of the pose (layout of `transforms.apply_increment`), (nstep, 27)."""
    object_poses: Float
    """Object in the world, shape (nstep, 7)."""
    object_velocities: Float
    """Linear [m/s] and angular velocity [rad/s] in the world, shape (nstep, 6)."""
    stages: NDArray[np.int64]
    """`Stage` of each step, shape (nstep,)."""

    @property
    def holding(self) -> NDArray[np.bool_]:
        """Steps in which the object must stay where it is, shape (nstep,)."""
        return self.stages == Stage.HOLDING


def reference(
    times: ArrayLike,
    hand_poses: ArrayLike,
    object_poses: ArrayLike,
    phases: ArrayLike,
    *,
    timestep: float,
    take_time: float,
    hold_time: float,
) -> Reference:
    """Sample a plan at the rate of the simulation.

    Args:
        times: Times of the plan's frames [s], rising, shape (nframe,).
        hand_poses: Hand in the world, shape (nframe, 28).
        object_poses: Object in the world, shape (nframe, 7).
        phases: Names of `PHASES`, in their order, shape (nframe,).
        timestep: Time between steps [s].
        take_time: Pause after closing [s].
        hold_time: Pause after manipulation [s].

    Raises:
        InputError: The arrays do not fit, times do not rise, or phases are unknown or out of order.
    """
    times = np.asarray(times, np.float64)
    hands, things = np.asarray(hand_poses, np.float64), np.asarray(object_poses, np.float64)
    names = np.asarray(phases)
    count = len(times)
    if hands.shape != (count, 28) or things.shape != (count, 7) or names.shape != (count,):
        raise InputError(
            f"a plan of {count} times has hand poses of shape {hands.shape}, object poses of shape "
            f"{things.shape} and phases of shape {names.shape}"
        )
    if count < 2 or not (np.diff(times) > 0.0).all():
        raise InputError("a plan needs at least two frames, and their times must rise")
    order = phase_numbers(names, of="the plan")
    clock, stages = _clock(times, order, timestep, take_time, hold_time)
    hand = sampled_poses(times, hands, clock)
    thing = sampled_poses(times, things, clock)
    return Reference(
        times=np.arange(len(clock), dtype=np.float64) * timestep,
        hand_poses=hand,
        hand_velocities=_rates(hand, timestep, own_frame=True),
        object_poses=thing,
        object_velocities=_rates(thing, timestep, own_frame=False),
        stages=stages,
    )


def _clock(
    times: Float, order: NDArray, timestep: float, take: float, hold: float
) -> tuple[Float, NDArray[np.int64]]:
    """Plan time and stage of every step."""
    end = times[-1]
    first = [times[order >= k][0] if (order >= k).any() else end for k in range(4)]
    grasps = bool((order >= 1).any())
    parts = [
        (Stage.REACHING, np.arange(times[0], first[1], timestep)),
        (Stage.CLOSING, np.arange(first[1], first[2], timestep)),
        (Stage.TAKING, np.full(round(take / timestep) if grasps else 0, first[2])),
        (Stage.CARRYING, np.arange(first[2], first[3], timestep)),
        (Stage.HOLDING, np.full(round(hold / timestep), first[3])),
        (Stage.RELEASING, np.arange(first[3], end, timestep)),
    ]
    clock = np.concatenate([part for _, part in parts])
    return clock, np.repeat([int(stage) for stage, _ in parts], [len(part) for _, part in parts])


def sampled_poses(times: Float, poses: Float, clock: Float) -> Float:
    """Poses between frames, linearly; rotations turn evenly.

    Args:
        times: Times of the frames, rising, shape (nframe,).
        poses: Place, quaternion and perhaps angles, shape (nframe, 7 or more).
        clock: Times that are wanted, shape (n,); those outside count as the first or last.

    Returns:
        Poses, shape (n, 7 or more).
    """
    clock = clock.clip(times[0], times[-1])
    out = np.empty((len(clock), poses.shape[1]))
    for column in (*range(3), *range(7, poses.shape[1])):
        out[:, column] = np.interp(clock, times, poses[:, column])
    turns = Slerp(times, Rotation.from_quat(poses[:, 3:7], scalar_first=True))(clock)
    out[:, 3:7] = turns.as_quat(canonical=True, scalar_first=True)
    return out


def _rates(poses: Float, timestep: float, *, own_frame: bool) -> Float:
    """Increments per second from each step to the next, smoothed over two of a plan's frames."""
    linear = np.gradient(poses[:, :3], timestep, axis=0)
    turns = Rotation.from_quat(poses[:, 3:7], scalar_first=True)
    step = turns[:-1].inv() * turns[1:] if own_frame else turns[1:] * turns[:-1].inv()
    spin = np.zeros((len(poses), 3))
    spin[:-1] = step.as_rotvec() / timestep
    rates = [linear, spin]
    if own_frame:
        rates.append(np.gradient(poses[:, 7:], timestep, axis=0))
    out = np.concatenate(rates, axis=1)
    if own_frame and out.shape[1] != NV:
        raise InputError(f"hand poses have {poses.shape[1]} entries; expected 28")
    return _smoothed(out, max(round(0.02 / timestep), 1))


def _smoothed(values: Float, width: int) -> Float:
    """Moving mean over `width` steps of every column; frames of a plan make velocities jump."""
    kernel = np.ones(width) / width
    padded = np.pad(values, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    return np.stack(
        [np.convolve(padded[:, k], kernel, mode="valid") for k in range(values.shape[1])], axis=1
    )
