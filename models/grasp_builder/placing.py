"""Which grip modes suit which objects, and how a hand comes at an object in each trial.

The hand comes from -x. Its fingers press along the pressing direction, from the thumb to the
fingers, level with the table; it approaches along a direction at a right angle to that, from level
(as one takes a glass) to steep (as one picks up a ball).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import rotvec_to_matrix

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Manner:
    """How a grip mode comes at things. Angles in degrees, ranges that trials are drawn from."""

    steepness: tuple[float, float]
    """How far the approach points down."""
    roll: tuple[float, float]
    """Turn of the pressing direction about the approach; 0 has the thumb on the left."""
    height: tuple[float, float]
    """Where fingers press, as a share of the object's half height above its centre."""
    objects: tuple[str, ...]
    """Database objects that the grip suits."""
    trials: int = 1
    """How many times the usual number of trials; more where few objects suit."""


_SMALL = ("ball_45", "block_40_40_60", "block_30_80_50", "cylinder_35_100", "cylinder_55_120")
_MIDDLE = (*_SMALL, "ball_65", "block_60_60_80", "cylinder_75_60")

MANNERS: dict[str, Manner] = {
    "palmar_pinch": Manner(
        steepness=(30, 60), roll=(-20, 15), height=(0.0, 0.25), objects=_SMALL,
    ),
    "middle_pinch": Manner(
        steepness=(30, 60), roll=(-20, 15), height=(0.0, 0.25), objects=_SMALL,
    ),
    "tripod": Manner(
        steepness=(25, 60), roll=(-20, 15), height=(0.0, 0.25), objects=_MIDDLE,
    ),
    "quadpod": Manner(
        steepness=(30, 65), roll=(-20, 15), height=(0.0, 0.25),
        objects=(*_MIDDLE, "ball_85", "block_80_80_80"),
    ),
    "prismatic_4_finger": Manner(
        steepness=(15, 60), roll=(-15, 10), height=(-0.2, 0.1),
        objects=(
            "block_60_60_80", "block_30_80_50", "block_80_80_80", "cylinder_35_100",
            "cylinder_55_120", "cylinder_75_60",
        ),
    ),
    "without_index": Manner(
        steepness=(20, 60), roll=(-15, 10), height=(-0.2, 0.1),
        objects=(
            "ball_65", "block_60_60_80", "block_30_80_50", "block_80_80_80", "cylinder_35_100",
            "cylinder_55_120", "cylinder_75_60",
        ),
    ),
    "precision_sphere": Manner(
        steepness=(40, 70), roll=(-20, 15), height=(0.0, 0.2),
        objects=("ball_45", "ball_65", "ball_85", "cylinder_75_60", "cylinder_55_120"),
    ),
    "power_sphere": Manner(
        steepness=(45, 70), roll=(-20, 15), height=(-0.05, 0.15),
        objects=("ball_65", "ball_85", "cylinder_75_60"),
        trials=2,
    ),
    "medium_wrap": Manner(
        steepness=(0, 15), roll=(-10, 15), height=(-0.1, 0.15),
        objects=("cylinder_55_120", "cylinder_75_60"),
        trials=3,
    ),
    "precision_disk": Manner(
        steepness=(60, 78), roll=(-20, 15), height=(0.1, 0.4),
        objects=(
            "ball_85", "cylinder_75_60", "cylinder_55_120", "block_60_60_80", "block_80_80_80",
        ),
    ),
}  # fmt: skip
"""Manner of each grip mode. What is not listed does not exist: the object is too small, too large
or too low for the grip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing:
    """One trial: frame with z up, the origin in the object's centre of mass, the hand at -x."""

    turn: Float
    """Rotation of the object about z, shape (3, 3)."""
    yaw: float
    """Its angle [rad]."""
    press: Float
    """Unit direction from the thumb to the fingers, shape (3,)."""
    approach: Float
    """Unit direction in which the hand comes, shape (3,)."""
    middle: Float
    """Between the pressing fingers [m], shape (3,)."""


def draw_placing(manner: Manner, thing: RigidObject, rng: np.random.Generator) -> Placing:
    """Draw a trial of a grip mode and an object."""
    steep, roll = np.deg2rad(rng.uniform(*manner.steepness)), np.deg2rad(rng.uniform(*manner.roll))
    approach = np.array([np.cos(steep), 0.0, -np.sin(steep)])
    press = rotvec_to_matrix(roll * approach) @ np.array([0.0, -1.0, 0.0])
    yaw = _facing(thing, press, rng)
    half = 0.5 * float(np.ptp(thing.vertices[:, 2]))
    centre = thing.vertices[:, 2].min() + half
    middle = np.array([0.0, 0.0, centre + half * rng.uniform(*manner.height)])
    return Placing(
        turn=rotvec_to_matrix(np.array([0.0, 0.0, yaw])), yaw=yaw, press=press, approach=approach,
        middle=middle,
    )  # fmt: skip


def _facing(thing: RigidObject, press: Float, rng: np.random.Generator) -> float:
    """Yaw of the object: a narrow pair of a block's sides across the pressing direction."""
    heading = np.arctan2(press[1], press[0])
    sides = np.ptp(thing.vertices, axis=0)[:2]
    if thing.primitive is None or thing.primitive.kind != "box":
        return float(rng.uniform(-np.pi, np.pi))
    narrow = np.flatnonzero(sides <= sides.min() + 0.021)
    axis = int(rng.choice(narrow))
    off = np.deg2rad(rng.normal(0.0, 4.0))
    return float(heading - axis * 0.5 * np.pi + off + np.pi * rng.integers(2))
