"""Particle swarm over closing motions and over how they are placed (thesis III.4.1.4).

A database motion comes from one side; turned about the vertical it comes from any. The swarm is cut
into groups that do not hear of each other, so that the last generation holds several different
grasps for the test of feasibility.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.transforms import matrix_to_quat, moved_poses, rotvec_to_matrix

Float = NDArray[np.float64]

NPLACE = 6
"""Placement of a motion: yaw [rad], offset in the grasp frame [m], and two tilts [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmConfig:
    """Settings of the swarm."""

    particles: int = 128
    """Motions in the swarm."""
    groups: int = 8
    """Groups of particles, each with its own leader."""
    generations: int = 24
    """Scorings of the whole swarm, the first where it is drawn."""
    cognitive: float = 2.05
    """Pull towards the best a particle has seen itself."""
    social: float = 2.05
    """Pull towards the best its group has seen."""
    yaw_spread: float = 0.7
    """Deviation of the first swarm's directions of approach from the wanted one [rad]."""
    offset_spread: float = 0.015
    """Deviation of placements, per axis [m]; also that of their prior."""
    tilt_spread: float = 0.15
    """Deviation of tilts [rad]; also that of their prior."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not 1 <= self.groups <= self.particles:
            raise InputError(
                f"{self.groups} groups of {self.particles} particles; expected at least one each"
            )
        if self.generations < 1:
            raise InputError(f"generations is {self.generations}; expected at least 1")
        if self.cognitive + self.social <= 4:
            raise InputError(
                f"cognitive and social are {self.cognitive} and {self.social}; expected a sum"
                " above 4"
            )
        spreads = (self.yaw_spread, self.offset_spread, self.tilt_spread)
        if not all(np.isfinite(s) and s > 0 for s in spreads):
            raise InputError(f"spreads are {spreads}; expected all above 0")

    @property
    def constriction(self) -> float:
        """Clerc and Kennedy's factor of every new velocity (2002), so that the swarm settles."""
        psi = self.cognitive + self.social
        return 2.0 / abs(2.0 - psi - np.sqrt(psi**2 - 4.0 * psi))

    @property
    def place_spread(self) -> Float:
        """Deviations of a placement, shape (6,)."""
        return np.repeat([self.yaw_spread, self.offset_spread, self.tilt_spread], [1, 3, 2])

    def log_prior(self, places: Float) -> Float:
        """Log density of placements up to a constant, shape (n,); every yaw is as good."""
        scaled = places[:, 1:] / self.place_spread[1:]
        return -0.5 * (scaled**2).sum(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Swarm:
    """A swarm after its last generation."""

    positions: Float
    """The best that each particle has seen, shape (n, nweight + 6), best first."""
    costs: Float
    """Their costs, rising, shape (n,)."""
    order: NDArray[np.intp]
    """Numbers of the particles, shape (n,)."""
    history: Float
    """Best cost after every generation, shape (generations,)."""


def search(
    cost: Callable[[Float], Float],
    first: Float,
    spread: Float,
    *,
    config: SwarmConfig,
    rng: np.random.Generator,
) -> Swarm:
    """Minimise a cost.

    Args:
        cost: Costs, shape (n,), of positions, shape (n, ndim).
        first: First positions, shape (n, ndim); particles k, k + groups, ... are one group.
        spread: Size of each coordinate: scales first velocities and bounds later ones, (ndim,).
        config: Settings.
        rng: Source of chance.
    """
    at = np.array(first, np.float64)
    velocity = 0.3 * spread * rng.standard_normal(at.shape)
    best, best_cost = at.copy(), np.full(len(at), np.inf)
    group = np.arange(len(at)) % config.groups
    members = [np.flatnonzero(group == g) for g in range(config.groups)]
    history = np.empty(config.generations)
    for generation in range(config.generations):
        if generation > 0:
            leaders = np.array([m[best_cost[m].argmin()] for m in members])[group]
            own, shared = rng.random((2, *at.shape))
            velocity += config.cognitive * own * (best - at)
            velocity += config.social * shared * (best[leaders] - at)
            velocity *= config.constriction
            np.clip(velocity, -spread, spread, out=velocity)
            at = at + velocity
        found = cost(at)
        better = found < best_cost
        best[better], best_cost[better] = at[better], found[better]
        history[generation] = best_cost.min()
    order = np.argsort(best_cost, kind="stable")
    return Swarm(positions=best[order], costs=best_cost[order], order=order, history=history)


def draw_places(
    count: int, yaw: float | None, *, config: SwarmConfig, rng: np.random.Generator
) -> Float:
    """First placements, shape (count, 6).

    Args:
        count: How many.
        yaw: Wanted direction of approach about the vertical [rad]; None: any.
        config: Settings.
        rng: Source of chance.
    """
    places = config.place_spread * rng.standard_normal((count, NPLACE))
    places[:, 3] *= 0.5  # the height of the hand matters most: the table is near
    places[:, 0] = rng.uniform(-np.pi, np.pi, count) if yaw is None else places[:, 0] + yaw
    return places


def place_motions(motions: Float, places: Float, R_object_up: Float) -> Float:
    """Motions in the grasp frame as motions in the object's frame, shape (n, nframe, 28).

    Args:
        motions: Hand poses in the grasp frame, shape (n, nframe, 28).
        places: Placements, shape (n, 6): yaw of the grasp frame about the vertical, offset in it,
            tilts about its x and y.
        R_object_up: Rotation from the frame that is upright in the world to the object's, (3, 3).
    """
    turn, tilt = (part[:, None] for part in _place_turns(places, R_object_up))
    return moved_poses(motions, turn @ tilt, (turn @ places[:, None, 1:4, None])[..., 0])


def place_increments(bases: Float, increments: Float, places: Float, R_object_up: Float) -> Float:
    """`place_motions` of motions told as increments from a pose each, in fewer steps.

    Args:
        bases: Poses with place and angles 0, shape (n, 28).
        increments: Increments from them, shape (n, nframe, 27).
        places: Placements, shape (n, 6).
        R_object_up: Rotation from the upright frame to the object's, shape (3, 3).
    """
    turn, tilt = _place_turns(places, R_object_up)
    placed = np.empty((*increments.shape[:2], bases.shape[1]))
    points = np.einsum("nij,ntj->nti", tilt, increments[..., :3]) + places[:, None, 1:4]
    placed[..., :3] = np.einsum("nij,ntj->nti", turn, points)
    first = _quat_product(matrix_to_quat(turn @ tilt), bases[:, 3:7])
    half = 0.5 * increments[..., 3:6]
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    spin = np.concatenate([np.cos(angle), np.sinc(angle / np.pi) * half], axis=-1)
    placed[..., 3:7] = _quat_product(first[:, None], spin)
    placed[..., 7:] = increments[..., 6:]
    return placed


def _place_turns(places: Float, R_object_up: Float) -> tuple[Float, Float]:
    """Rotations by yaw, into the object's frame, and by the tilts, each (n, 3, 3)."""
    zero = np.zeros(len(places))
    turn = R_object_up @ rotvec_to_matrix(np.stack([zero, zero, places[:, 0]], 1))
    return turn, rotvec_to_matrix(np.stack([places[:, 4], places[:, 5], zero], 1))


def _quat_product(first: Float, second: Float) -> Float:
    """Quaternions of one turn after another, w first, shape (..., 4)."""
    a, x, y, z = np.moveaxis(first, -1, 0)
    b, u, v, w = np.moveaxis(second, -1, 0)
    return np.stack([
        a * b - x * u - y * v - z * w, a * u + x * b + y * w - z * v,
        a * v - x * w + y * b + z * u, a * w + x * v - y * u + z * b,
    ], axis=-1)  # fmt: skip
