"""Particle swarm over closing motions and over how they are placed (thesis III.4.1.4).

A database motion comes from one side; turned about the vertical it comes from any. The swarm is cut
into groups that do not hear of each other, so that the last generation holds several different
grasps for the test of feasibility.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.transforms import moved_poses, rotvec_to_matrix

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


Cost = Callable[[Float, Float], Float]
"""Costs, shape (n,), of positions, shape (n, ndim), and bounds, shape (n,): a cost that is no lower
than its bound may come out as inf."""


def parts_of(config: SwarmConfig, count: int) -> list[NDArray[np.intp]]:
    """Numbers of the particles of whole groups, in at most so many parts of about the same size."""
    count = min(count, config.groups)
    group = np.arange(config.particles) % config.groups
    return [np.flatnonzero(group % count == part) for part in range(count)]


def search(
    costs: Sequence[Cost],
    first: Float,
    spread: Float,
    *,
    config: SwarmConfig,
    rng: np.random.Generator,
) -> Swarm:
    """Minimise a cost; what is found does not depend on the number of threads.

    Args:
        costs: The cost, once for each of the `parts_of` the swarm; each has a thread.
        first: First positions, shape (n, ndim); particles k, k + groups, ... are one group.
        spread: Size of each coordinate: scales first velocities and bounds later ones, (ndim,).
        config: Settings.
        rng: Source of chance.
    """
    parts, rngs = parts_of(config, len(costs)), rng.spawn(config.groups)

    def run(part: int) -> tuple[Float, Float, Float]:
        own = parts[part]
        # Groups part, part + nparts, ... are numbered 0, 1, ... within the part.
        groups = own % config.groups // len(parts)
        return _search_part(
            costs[part], np.array(first[own], np.float64), spread, groups, rngs[part :: len(parts)],
            config,
        )  # fmt: skip

    if len(parts) == 1:
        found = [run(0)]
    else:
        with ThreadPoolExecutor(len(parts)) as pool:
            found = list(pool.map(run, range(len(parts))))
    positions, best = np.empty(np.shape(first)), np.empty(len(first))
    for own, (at, cost, _) in zip(parts, found, strict=True):
        positions[own], best[own] = at, cost
    order = np.argsort(best, kind="stable")
    return Swarm(
        positions=positions[order], costs=best[order], order=order,
        history=np.min([history for _, _, history in found], axis=0),
    )  # fmt: skip


def _search_part(
    cost: Cost, at: Float, spread: Float, group: NDArray[np.intp],
    rngs: Sequence[np.random.Generator], config: SwarmConfig,
) -> tuple[Float, Float, Float]:  # fmt: skip
    """Best positions and costs of some groups, and their best cost after every generation."""
    members = [np.flatnonzero(group == g) for g in range(len(rngs))]
    velocity = np.empty(at.shape)
    for rng, own in zip(rngs, members, strict=True):
        velocity[own] = rng.standard_normal((len(own), len(spread)))
    velocity *= 0.3 * spread
    best, best_cost = at.copy(), np.full(len(at), np.inf)
    history, pulls = np.empty(config.generations), np.empty((2, *at.shape))
    leaders = np.empty(len(at), np.intp)
    for generation in range(config.generations):
        if generation > 0:
            for rng, own in zip(rngs, members, strict=True):
                leaders[own] = own[best_cost[own].argmin()]
                pulls[:, own] = rng.random((2, len(own), len(spread)))
            velocity += config.cognitive * pulls[0] * (best - at)
            velocity += config.social * pulls[1] * (best[leaders] - at)
            velocity *= config.constriction
            np.clip(velocity, -spread, spread, out=velocity)
            at += velocity
        found = cost(at, best_cost)
        better = found < best_cost
        best[better], best_cost[better] = at[better], found[better]
        history[generation] = best_cost.min()
    return best, best_cost, history


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
    zero = np.zeros(len(places))
    turn = R_object_up @ rotvec_to_matrix(np.stack([zero, zero, places[:, 0]], 1))[:, None]
    tilt = rotvec_to_matrix(np.stack([places[:, 4], places[:, 5], zero], 1))[:, None]
    return moved_poses(motions, turn @ tilt, (turn @ places[:, None, 1:4, None])[..., 0])
