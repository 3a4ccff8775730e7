"""Start poses for a hand that is no longer explained: fingers re-set at random, palm shaken.

Model-based tracking ends in a local minimum when fingers are confused or the palm has slid along
the forearm; other starts around the last pose find the way back (random restarts as in Qian et al.,
"Realtime and robust hand tracking from depth", CVPR 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLE_BONES, FINGERS, finger_of_bone
from handtrack.transforms import apply_increment, quat_to_matrix

THUMB_STATES = ((0.1, 0.2, 0.1, 0.0, 0.1), (0.5, 0.3, 0.5, 0.0, 0.6), (0.3, 0.6, 0.3, 0.0, 0.3))
"""Thumb beside the hand, across the palm, opposed: its five angles [rad]."""

FINGER_STATES = (
    (0.05, 0.0, 0.1, 0.05),
    (1.3, 0.0, 1.6, 0.7),
    (0.7, 0.0, 0.9, 0.4),
    (0.1, 0.0, 1.5, 0.6),
)
"""Finger straight, in a fist, half bent, hooked: its four angles [rad]."""

RESET_CHANCE = 0.6
"""Share of fingers that are re-set in one start."""

SLIDES = (0.0, 0.0, 0.02, 0.04, -0.02)
"""Displacements of the palm along itself [m]; the palm slides onto the forearm more often than off
it."""

PALM_SPREAD, PALM_TURN, ANGLE_SPREAD = 0.005, 0.25, 0.1
"""Deviations of the palm's place [m], its direction [rad] and the joint angles [rad]."""

OVER_SHARES = (0.4, 0.15, 0.2, 0.25)
"""How often a hand that is turned over shows the back for the palm, has the fingers where the wrist
was, turns about its palm's normal, or about any axis."""

OVER_YAW, OVER_RANGE, OVER_SPREAD = 0.7, (0.4, 1.6), 0.15
"""Deviation of the third turn, range of the fourth, and deviation added to all of them [rad]."""

_ANGLE_FINGERS = np.array([finger_of_bone(bone) for bone in ANGLE_BONES])


def restart_poses(
    hand: ShapedHand, pose: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw start poses around a pose.

    Args:
        hand: Whose joint limits apply.
        pose: Pose to shake, shape (28,).
        count: How many to draw.
        rng: Source of the random numbers.

    Returns:
        Poses within the joint limits, shape (count, 28).
    """
    turn = np.zeros((count, 27))
    turn[:, 3:6] = rng.normal(0.0, PALM_TURN, (count, 3))
    poses = apply_increment(np.tile(pose, (count, 1)), turn)
    along = quat_to_matrix(pose[3:7])[:, 0]
    poses[:, :3] += rng.choice(SLIDES, count)[:, None] * along
    poses[:, :3] += rng.normal(0.0, PALM_SPREAD, (count, 3))
    for finger in range(len(FINGERS)):
        states = np.array(THUMB_STATES if finger == 0 else FINGER_STATES)
        drawn = states[rng.integers(len(states), size=count)]
        mine = 7 + np.flatnonzero(_ANGLE_FINGERS == finger)
        reset = (rng.random(count) < RESET_CHANCE)[:, None]
        poses[:, mine] = np.where(reset, drawn, poses[:, mine])
    poses[:, 7:] += rng.normal(0.0, ANGLE_SPREAD, (count, len(_ANGLE_FINGERS)))
    poses[:, 7:] = np.clip(poses[:, 7:], hand.limits[:, 0], hand.limits[:, 1])
    return poses


def turned_over(
    hand: ShapedHand, poses: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Turn hands far from where they are, about their middle.

    Depth shows the back of a flat hand as it shows its palm; a search that only shakes a pose does
    not get from one to the other.

    Args:
        hand: Whose hand it is.
        poses: Poses to turn, shape (n, 28).
        rng: Source of the random numbers.

    Returns:
        Poses with the same joint angles, shape (n, 28).
    """
    count = len(poses)
    axes = rng.normal(size=(count, 3))
    axes *= (rng.uniform(*OVER_RANGE, count) / np.linalg.norm(axes, axis=1))[:, None]
    ways = np.zeros((4, count, 3))
    ways[0, :, 0] = ways[1, :, 1] = np.pi
    ways[2, :, 1] = rng.normal(0.0, OVER_YAW, count)
    ways[3] = axes
    turn = np.zeros((count, 27))
    turn[:, 3:6] = ways[rng.choice(4, count, p=OVER_SHARES), np.arange(count)]
    turn[:, 3:6] += rng.normal(0.0, OVER_SPREAD, (count, 3))
    turned = apply_increment(poses, turn)
    middle = keypoints(hand, poses).mean(axis=1)
    turned[:, :3] += middle - keypoints(hand, turned).mean(axis=1)
    return turned
