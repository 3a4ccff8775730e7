"""Synthesis of the closing motion (thesis III.4.1): search, pull onto the surface, test, choose.

A particle swarm searches the coordinates of the motion model, of several grip modes side by side.
The best particles of its last generation are pulled onto the surface and tested for whether they
can carry the object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.contact_ik import ContactIkConfig, blend_correction, pull_contacts
from handtrack.grasp.feasibility import feasible
from handtrack.grasp.grip_device import GripDevice
from handtrack.grasp.motion_model import GripModel
from handtrack.grasp.objective import GraspObjective, ObjectiveConfig, Scores, Wish
from handtrack.grasp.swarm import (
    NPLACE,
    Swarm,
    SwarmConfig,
    draw_places,
    parts_of,
    place_motions,
    search,
)
from handtrack.grasp.taxonomy import GripPads
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NQ
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosingConfig:
    """Settings of the synthesis of closing motions."""

    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    """Weights of Eq. III.4."""
    swarm: SwarmConfig = field(default_factory=SwarmConfig)
    """The search with the grip modes that are left; its particles are shared among them."""
    screening: SwarmConfig = field(
        default_factory=lambda: SwarmConfig(particles=24, groups=1, generations=8)
    )
    """The first search, of each grip mode, where there are more than are to be left."""
    screened: int = 3
    """Grip modes that are left after the first search."""
    ik: ContactIkConfig = field(default_factory=ContactIkConfig)
    """How contacts are pulled onto the surface."""
    candidates: int = 8
    """Particles of the last generation that are pulled and tested."""
    attempts: int = 3
    """Searches at most, until a grasp is feasible, clear and good."""
    good_cost: float = 5.5
    """Cost per contact up to which a grasp is good: most are at half of it."""
    frames: int = 8
    """Frames of a motion that are scored (thesis Table III.2)."""
    example_share: float = 0.5
    """Share of the first swarm that starts near recordings rather than drawn from the mixture."""
    friction_shares: tuple[float, ...] = (0.25, 0.35, 0.45, 0.6)
    """Shares of the friction that grasps are tested with, rising. One that does with less is taken
    before one that needs more; a good one does with the first, and one that needs more than the
    last is not feasible."""
    load: float = 1.5
    """What a grasp must carry, in weights of the object: it is to be moved."""
    few_contacts: float = 2.0
    """What having only two contacts costs among grip modes; more cost less, as their inverse."""
    most_depth: float = 0.003
    """Overlap of a finished grasp with object or table beyond which others go first [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for name, least in (("screened", 1), ("candidates", 1), ("attempts", 1), ("frames", 2)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least {least}")
        shares = np.array(self.friction_shares)
        if not (len(shares) and shares[0] > 0 and shares[-1] <= 1 and (np.diff(shares) > 0).all()):
            raise InputError(
                f"friction_shares is {self.friction_shares}; expected rising in (0, 1]"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosingGrasp:
    """A closing motion that ends in a grasp, in the object's frame."""

    grip: str
    """Name of the grip mode."""
    motion: Float
    """Hand poses at the motion model's frame rate, shape (nframe, 28)."""
    pads: GripPads
    """Where the hand touches."""
    points: Float
    """Where on the object [m], shape (ncontact, 3)."""
    normals: Float
    """Outward normals there, shape (ncontact, 3)."""
    friction_share: float
    """Least of the tested shares of the friction with which it can carry the object; infinite where
    none does."""
    clear: bool
    """Whether the hand is neither too deep in object or table nor too near to other things."""
    costs: dict[str, float]
    """Weighted terms of the objective."""

    @property
    def feasible(self) -> bool:
        """Whether it can carry the object."""
        return bool(np.isfinite(self.friction_share))

    @property
    def cost(self) -> float:
        """Sum of the terms."""
        return sum(self.costs.values())


class ClosingSynthesizer:
    """Searches closing motions of some grip modes about one object that stands still."""

    def __init__(
        self,
        hand: ShapedHand,
        body: RigidObject,
        distances: DistanceField,
        models: Sequence[GripModel],
        *,
        place: Float,
        yaw: float | None = None,
        wish: Wish | None = None,
        room: Callable[[Float], Float] | None = None,
        config: ClosingConfig | None = None,
        device: str | None = None,
        grips: GripDevice | None = None,
    ) -> None:
        """Prepare.

        Args:
            hand: A right hand.
            body: The object.
            distances: Its signed distances.
            models: Motion models of the grip modes to choose from.
            place: Pose of the object in the world, shape (7,); the table is z = 0.
            yaw: Wanted direction from the hand to the object about the vertical [rad]; None: any.
            wish: What the user asks for.
            room: Distance from other things [m], shape (n,), of a hand that holds the object, whose
                poses in the object's frame are of shape (n, 28).
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            grips: The same hand with these models and perhaps others, uploaded before.
        """
        self.config = config if config is not None else ClosingConfig()
        self.hand, self.body, self.distances = hand, body, distances
        if grips is None:
            skin_points = self.config.objective.skin_points
            grips = GripDevice(hand, models, skin_points=skin_points, device=device)
        self.models, self.pads, self.yaw = grips.models, grips.pads, yaw
        self._grips, self._room = grips, room
        self._chosen = np.array([grips.number(model.grip) for model in models])
        self._turn = quat_to_matrix(place[3:]).T  # from the upright frame to the object's
        self._table = np.append(self._turn @ [0.0, 0.0, 1.0], -place[2])
        self._width = grips.motions.nweight
        self._objective = GraspObjective(
            grips, distances, friction=body.friction, table=self._table, wish=wish,
            room=room, config=self.config.objective,
        )  # fmt: skip

    def run(self, seed: int = 0) -> ClosingGrasp:
        """The best grasp that can carry the object; where none is found, the best that cannot."""
        best: ClosingGrasp | None = None
        for attempt in range(self.config.attempts):
            rng = np.random.default_rng([seed, attempt])
            for grasp in self._finished(*self._search(rng)):
                if best is None or self._rank(grasp) < self._rank(best):
                    best = grasp
                if grasp.clear and grasp.friction_share <= self.config.friction_shares[0]:
                    break  # those that follow cost more
            assert best is not None
            good = False, False, self.config.friction_shares[0], self.config.good_cost
            if self._rank(best) <= good:
                break
        assert best is not None
        return best

    def _rank(self, grasp: ClosingGrasp) -> tuple[bool, bool, float, float]:
        cost = self._by_contact(grasp.cost, len(grasp.points))
        return not grasp.feasible, not grasp.clear, grasp.friction_share, float(cost)

    def _fair(self, costs: Float, grips: NDArray[np.intp]) -> Float:
        """Costs that compare between grip modes, shape (n,), of the objective's, shape (n,)."""
        return self._by_contact(costs, np.array([len(pads.bones) for pads in self.pads])[grips])

    def _by_contact(self, cost: ArrayLike, count: ArrayLike) -> Float:
        # Many contacts add up more distances and angles, and hold all the better.
        return (np.asarray(cost) + 2.0 * self.config.few_contacts) / np.asarray(count)

    # Search

    def _search(self, rng: np.random.Generator) -> tuple[Swarm, NDArray[np.intp]]:
        """The swarm of the grip modes that are left, and the grip mode of each particle."""
        config, chosen = self.config, self._chosen
        seeds: Float | None = None
        if len(chosen) > config.screened:
            count = len(chosen)
            screening = replace(
                config.screening, particles=count * config.screening.particles,
                groups=count * config.screening.groups,
            )  # fmt: skip
            swarm, grips = self._run_swarm(chosen, screening, None, rng)
            per_contact = self._fair(swarm.costs, grips)
            order = [
                int(np.flatnonzero(grips == g)[per_contact[grips == g].argmin()]) for g in chosen
            ]
            kept = np.argsort(per_contact[order], kind="stable")[: config.screened]
            chosen, seeds = chosen[kept], swarm.positions[np.array(order)[kept]]
        groups = len(chosen) * max(config.swarm.groups // len(chosen), 1)
        main = replace(config.swarm, groups=groups, particles=max(config.swarm.particles, groups))
        return self._run_swarm(chosen, main, seeds, rng)

    def _run_swarm(
        self, chosen: NDArray[np.intp], config: SwarmConfig, seeds: Float | None,
        rng: np.random.Generator,
    ) -> tuple[Swarm, NDArray[np.intp]]:  # fmt: skip
        # Particles k, k + groups, ... are one group, and a group is of one grip mode.
        grips = chosen[np.arange(config.particles) % config.groups % len(chosen)]
        first = np.zeros((config.particles, self._width + NPLACE))
        first[:, self._width :] = draw_places(config.particles, self.yaw, config=config, rng=rng)
        for grip in chosen:
            own = np.flatnonzero(grips == grip)
            first[own, : self.models[grip].nweight] = self._draw(self.models[grip], len(own), rng)
        if seeds is not None:
            for grip, position in zip(chosen, seeds, strict=True):
                first[np.flatnonzero(grips == grip)[0]] = position
        spread = np.concatenate([np.ones(self._width), config.place_spread])
        parts = [grips[part] for part in parts_of(config, self._grips.threads)]
        with self._objective.costs(
            parts, nframe=self.config.frames, R_object_up=self._turn, swarm=config
        ) as costs:
            swarm = search(costs, first, spread, config=config, rng=rng)
        return swarm, grips[swarm.order]

    def _draw(self, model: GripModel, count: int, rng: np.random.Generator) -> Float:
        """First weights: drawn from the mixture, and near recordings."""
        weights = model.sample(rng, count)
        near = round(self.config.example_share * count)
        example = rng.integers(len(model.examples), size=near)
        weights[:near] = model.examples[example] + 0.2 * rng.standard_normal((near, model.nweight))
        return weights

    def _motions(
        self, positions: Float, grips: NDArray[np.intp], config: SwarmConfig
    ) -> tuple[Float, Float]:
        """Motions in the object's frame and the log density of their coordinates."""
        motions = np.empty((len(positions), self.config.frames, NQ))
        density = np.empty(len(positions))
        for grip in np.unique(grips):
            own, model = grips == grip, self.models[grip]
            weights = positions[own, : model.nweight]
            motions[own] = model.motions(weights, self.config.frames)
            density[own] = model.log_density(weights)
        places = positions[:, self._width :]
        motions = place_motions(motions, places, self._turn)
        return motions, density + config.log_prior(places)

    # Ending

    def _finished(self, swarm: Swarm, grips: NDArray[np.intp]) -> Iterator[ClosingGrasp]:
        """The best particles, pulled onto the surface and, one by one, tested; best first."""
        config = self.config
        order = np.argsort(self._fair(swarm.costs, grips), kind="stable")[: config.candidates]
        positions, grips = swarm.positions[order], grips[order]
        motions, density = self._motions(positions, grips, config.swarm)
        pulled = pull_contacts(
            self.hand, motions[:, -1], [self.pads[grip] for grip in grips], self.distances,
            table=self._table, config=config.ik,
        )  # fmt: skip
        blended = blend_correction(motions, pulled.poses)
        scores = self._objective(blended, grips, density)
        clear = pulled.depths <= config.most_depth
        if self._room is not None:
            clear &= self._room(pulled.poses) >= 0.5 * config.objective.clearance
        for k in np.lexsort([self._fair(scores.total, grips), ~clear]).tolist():
            grip, model = int(grips[k]), self.models[grips[k]]
            weights = positions[k, : model.nweight]
            _, motion = model.motion(weights[: model.nshape], weights[model.nshape :])
            placed = place_motions(motion[None], positions[k : k + 1, self._width :], self._turn)
            motion = blend_correction(placed[0], pulled.poses[k])
            yield self._grasp(k, grip, motion, scores, bool(clear[k]))

    def _grasp(self, k: int, grip: int, motion: Float, scores: Scores, clear: bool) -> ClosingGrasp:
        count = len(self.pads[grip].bones)
        points, normals = scores.points[k, :count], scores.normals[k, :count]
        up = self._turn @ [0.0, 0.0, 1.0]

        def enough(share: float) -> bool:
            return feasible(
                points, normals, friction=share * self.body.friction,
                mass=self.config.load * self.body.mass, gravity=-9.81 * up,
            ).feasible  # fmt: skip

        need = next((share for share in self.config.friction_shares if enough(share)), np.inf)
        return ClosingGrasp(
            grip=self.models[grip].grip, motion=motion, pads=self.pads[grip], points=points,
            normals=normals, friction_share=need, clear=clear,
            costs={name: float(values[k]) for name, values in scores.terms.items()},
        )  # fmt: skip
