"""Motions around a grasp: reaching, closing, manipulation and releasing, timed as people time them.

Wrist and object follow minimum-jerk paths (Flash and Hogan 1985). While reaching the fingers open
widest after two thirds of the way (Jeannerod 1984); closing fingers start a little one after the
other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grasp_builder.placing import Placing
from handtrack.grasp.recording import FRAME_RATE
from handtrack.grasp.reference import sampled_poses
from handtrack.grasp.taxonomy import GripMode
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, FINGERS
from handtrack.synthesis.motion import minimum_jerk
from handtrack.transforms import matrix_to_quat, moved_poses, quat_to_matrix, rotvec_to_matrix

Float = NDArray[np.float64]

PEAK_APERTURE = 0.66
"""Share of the reach after which the hand is widest open."""

EXTRA_APERTURE = 0.35
"""How much wider it is then than where closing starts, as a share of the grip's opening."""

RELAXED = 0.45
"""Posture at rest, as a share of the grip's opening from its closed posture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Durations of one trial [s] and the delays of its fingers."""

    reaching: float
    closing: float
    manipulation: float
    releasing: float
    """0 for trials that end with the object in hand."""
    delays: Float
    """Start of each finger's closing as a share of the phase, shape (5,)."""


def draw_timing(rng: np.random.Generator, *, releases: bool) -> Timing:
    """Draw the timing of a trial."""
    return Timing(
        reaching=rng.uniform(0.7, 1.0), closing=rng.uniform(0.35, 0.6),
        manipulation=rng.uniform(0.9, 1.4), releasing=0.5 if releases else 0.0,
        delays=rng.uniform(0.0, 0.15, 5),
    )  # fmt: skip


def _shares(duration: float) -> Float:
    return np.linspace(0.0, 1.0, round(duration * FRAME_RATE) + 1)


def closing_motion(
    hand: ShapedHand, mode: GripMode, placing: Placing, grasp: Float, timing: Timing,
    *, aperture: float, way: float,
) -> Float:  # fmt: skip
    """The grip closes while the palm comes the last bit, shape (nframe, 28).

    Args:
        hand: The hand.
        mode: The grip mode.
        placing: The trial's placing.
        grasp: Last pose, shape (28,).
        timing: Durations and delays.
        aperture: How far the hand opens, as a share of the grip's opening.
        way: How far the palm comes from [m].
    """
    share = _shares(timing.closing)
    poses = np.repeat(grasp[None], len(share), axis=0)
    low, high = hand.limits.T
    first = (grasp[7:] + aperture * np.array(mode.opening)).clip(low, high)
    fingers = [FINGERS.index(name.split("_")[0]) for name in ANGLES]
    delay = timing.delays[fingers]
    # All fingers arrive at the end, whenever they start.
    progress = minimum_jerk((share[:, None] - delay) / (1.0 - delay))
    poses[:, 7:] = first + progress * (grasp[7:] - first)
    poses[:, :3] -= (1.0 - minimum_jerk(share / 0.8))[:, None] * way * placing.approach
    return poses


def reaching_motion(
    hand: ShapedHand, mode: GripMode, end: Float, timing: Timing, rng: np.random.Generator
) -> Float:
    """From rest to where closing starts, shape (nframe, 28); its last frame is `end`."""
    share = _shares(timing.reaching)
    poses = np.repeat(end[None], len(share), axis=0)
    progress = minimum_jerk(share)
    start = end[:3] + np.array(
        [-rng.uniform(0.18, 0.28), rng.uniform(-0.12, 0.06), rng.uniform(0.0, 0.08)]
    )
    poses[:, :3] = start + progress[:, None] * (end[:3] - start)
    # People lift the hand over things: an arc that is highest half way.
    poses[:, 2] += rng.uniform(0.02, 0.05) * (4.0 * progress * (1.0 - progress)) ** 1.5
    turn = rng.normal(0.0, 0.25, 3)
    turns = rotvec_to_matrix((1.0 - progress)[:, None] * turn)
    poses[:, 3:7] = matrix_to_quat(turns @ quat_to_matrix(end[3:7]))
    low, high = hand.limits.T
    opening = np.array(mode.opening)
    relaxed = (np.array(mode.closed) + RELAXED * opening).clip(low, high)
    widest = (end[7:] + EXTRA_APERTURE * opening).clip(low, high)
    opens = minimum_jerk(share / PEAK_APERTURE)[:, None]
    closes = minimum_jerk((share - PEAK_APERTURE) / (1.0 - PEAK_APERTURE))[:, None]
    poses[:, 7:] = relaxed + opens * (widest - relaxed) + closes * (end[7:] - widest)
    return poses


def transport(first: Float, timing: Timing, rng: np.random.Generator, *, lands: bool) -> Float:
    """Path of the object from rest to a target, shape (nframe, 7).

    Args:
        first: The object at rest, shape (7,).
        timing: Durations.
        rng: Random numbers.
        lands: Whether the target stands on the table, rather than up in the air.
    """
    share = _shares(timing.manipulation)
    heading = rng.uniform(-np.pi, np.pi)
    goal = np.array([np.cos(heading), np.sin(heading), 0.0]) * rng.uniform(0.15, 0.3)
    goal[2] = 0.0 if lands else rng.uniform(0.1, 0.2)
    arc = rng.uniform(0.11, 0.16) if lands else rng.uniform(0.0, 0.03)
    progress = minimum_jerk(share)
    # The object leaves the table before it goes aside.
    rise = minimum_jerk(share / 0.75) if not lands else progress
    path = np.repeat(first[None], len(share), axis=0)
    aside = minimum_jerk((share - 0.08) / 0.84)
    path[:, :2] += aside[:, None] * goal[:2]
    path[:, 2] += rise * goal[2] + arc * (4.0 * progress * (1.0 - progress))
    turn = np.array([0.0, 0.0, rng.normal(0.0, 0.35)])
    if not lands:
        turn[:2] = rng.normal(0.0, 0.08, 2)
    turns = rotvec_to_matrix(aside[:, None] * turn)
    path[:, 3:7] = matrix_to_quat(turns @ quat_to_matrix(first[3:7]))
    return path


def releasing_motion(closing: Float, held: Float, timing: Timing) -> Float:
    """The closing motion backwards where the object was put down, shape (nframe, 28).

    Args:
        closing: The closing motion, shape (n, 28).
        held: Last pose of the manipulation, shape (28,).
        timing: Durations.
    """
    back = closing[::-1]
    frames = np.arange(len(back), dtype=np.float64)
    at = np.linspace(0.0, frames[-1], len(_shares(timing.releasing)))
    opened = sampled_poses(frames, back, at)
    swing = quat_to_matrix(held[3:7]) @ quat_to_matrix(back[0, 3:7]).T
    return moved_poses(opened, swing, held[:3] - swing @ back[0, :3])
