"""Tracking by particle swarm optimisation, the baseline of thesis II.6.2.1.

The method is that of Oikonomidis, Kyriazis and Argyros, "Efficient model-based 3D tracking of hand
articulations using Kinect", BMVC 2011: around the last pose a swarm of poses is drawn, rendered,
compared with the depth image, and drawn towards the best it has seen. No gradients are taken.
"""

from __future__ import annotations

import numbers
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, BASE_BONES, FINGERS, NV
from handtrack.tracking.stage_clock import StageClock
from handtrack.tracking.stepper import Estimate
from handtrack.transforms import apply_increment, pose_difference

_ABDUCTIONS = [ANGLES.index(f"{finger}_mcp_abduction") for finger in FINGERS[1:]]
_COUNTS = {"particles": 2, "generations": 1, "redraw_period": 0}
"""Settings that are counts, and the least value of each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PsoConfig:
    """Settings of the particle swarm tracker."""

    fit: FitConfig = field(default_factory=FitConfig)
    """Crop and scoring of one frame; its Gauss-Newton steps and energy terms are not used."""
    particles: int = 64
    """Poses in the swarm (thesis II.6.2.1)."""
    generations: int = 25
    """Scorings of the whole swarm per frame, the first of them where it is drawn (thesis
    II.6.2.1)."""
    cognitive: float = 2.8
    """c1: pull towards the best a particle has seen itself."""
    social: float = 1.3
    """c2: pull towards the best that the swarm has seen."""
    place_spread: float = 0.005
    """Deviation of the first swarm's palms from the last place, per axis [m]."""
    turn_spread: float = 0.05
    """Deviation of the first swarm's palms from the last direction, per axis [rad]."""
    angle_spread: float = 0.1
    """Deviation of the first swarm's joint angles from the last ones [rad]."""
    redraw_period: int = 3
    """Generations between re-draws of a joint angle in part of the swarm, which else collapses
    before the fingers are found; 0 switches them off."""
    redraw_share: float = 0.5
    """Share of the particles that re-draw a joint angle, each one of its own choice, anew within
    its limits."""
    crossing_weight: float = 0.01
    """Depth error that neighbouring fingers cost per angle by which they point past each other
    [m/rad]; 0 switches the term off."""
    lost_error: float = 0.02
    """tau of Eq. II.19: depth error above which the hand counts as lost [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for option in fields(self):
            if option.name == "fit":
                continue
            value, least = getattr(self, option.name), _COUNTS.get(option.name)
            number = float(value) if isinstance(value, numbers.Real) else np.nan
            if least is not None and not (isinstance(value, numbers.Integral) and number >= least):
                raise InputError(
                    f"{option.name} is {value!r}; expected a whole number of at least {least}"
                )
            if not (np.isfinite(number) and number >= 0):
                raise InputError(f"{option.name} is {value!r}; expected a finite number >= 0")
        if self.cognitive + self.social <= 4:
            # Below 4 the constriction of Clerc and Kennedy is not real.
            raise InputError(
                f"cognitive and social are {self.cognitive} and {self.social}; expected a sum"
                " above 4"
            )
        if self.redraw_share > 1:
            raise InputError(f"redraw_share is {self.redraw_share}; expected 0 to 1")
        if not 0 < self.lost_error <= self.fit.score_cap:
            raise InputError(
                f"lost_error is {self.lost_error}; expected up to score_cap {self.fit.score_cap}"
            )

    @property
    def constriction(self) -> float:
        """Clerc and Kennedy's w (2002): factor of every new velocity, so that the swarm settles."""
        psi = self.cognitive + self.social
        return 2.0 / abs(2.0 - psi - np.sqrt(psi**2 - 4.0 * psi))

    def make(
        self, hand: ShapedHand, camera: Camera, *, known_shape: bool, device: str | None,
        seed: int, graph: bool,
    ) -> TrackerPso:  # fmt: skip
        """Allocate the method; see `TrackerConfig`."""
        del known_shape  # the hand is taken as it is
        return TrackerPso(hand, camera, config=self, device=device, seed=seed, graph=graph)


def crossed_angles(hand: ShapedHand, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """By how much fingers point past their neighbours, the thumb left out.

    Args:
        hand: The hand.
        angles: Joint angles [rad], shape (n, 21).

    Returns:
        Sum over the three pairs of neighbours [rad], shape (n,); 0 where no fingers cross.
    """
    # In the plane of the palm, radial positive: where each finger points at zero, and how
    # abduction turns it.
    radial = 1.0 if hand.side == "right" else -1.0
    straight = hand.bone_rotations[list(BASE_BONES[1:]), :, 0]
    headings = radial * np.arctan2(straight[:, 2], straight[:, 0])
    turns = -radial * hand.angle_axes[_ABDUCTIONS, 1] * angles[:, _ABDUCTIONS]
    return np.maximum(np.diff(headings + turns, axis=1), 0.0).sum(axis=1)


class TrackerPso:
    """Follows one hand from a given first pose, by search around the last pose."""

    automatic = False

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        config: PsoConfig | None = None,
        device: str | None = None,
        seed: int = 0,
        graph: bool = True,
    ) -> None:
        """Allocate for one hand and camera.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            seed: Seed of the swarm.
            graph: False launches eagerly, for debugging.
        """
        self.config = config if config is not None else PsoConfig()
        self._hand = hand
        # Without steps a fit only renders and scores.
        scoring = replace(
            self.config.fit, iterations=0, levenberg=False, normal_reach=0, prior_weight=0.0
        )
        self._scorer = Fitter(
            [hand], camera, config=scoring, nhyp=self.config.particles, device=device, graph=graph
        )
        # Compile and capture now, not on the first frame.
        self._scorer.warm_up()
        spreads = (self.config.place_spread, self.config.turn_spread, self.config.angle_spread)
        self._spread = np.repeat(spreads, (3, 3, NV - 6))
        self._seed = seed
        self.start(None)

    @property
    def started(self) -> bool:
        """Whether there is a pose to go on from."""
        return self._pose is not None

    def start(self, pose: NDArray[np.float64] | None) -> None:
        """Go on from a pose at rest, shape (28,), or from nothing."""
        self._pose: NDArray[np.float64] | None = None
        if pose is not None:
            self._pose = np.array(pose, np.float64)
        self._rng = np.random.default_rng(self._seed)

    def forget(self) -> None:
        """Start from nothing; see `Stepper`."""
        self.start(None)

    def step(
        self, depth: NDArray[np.float32], *, fallback: NDArray[np.float64] | None = None
    ) -> Estimate:
        """Search for the hand in the next frame.

        Args:
            depth: Clean depth image [m], shape (height, width).
            fallback: Pose around which half of the swarm is drawn, shape (28,); for frames after a
                loss.

        Returns:
            The best pose that the swarm has seen.
        """
        clock = StageClock()
        pose = self._pose
        assert pose is not None, "start first"
        origins = np.stack([pose] if fallback is None else [pose, fallback])
        # The middle between the origins keeps each of them within the crop.
        centre = keypoints(self._hand, origins).mean(axis=(0, 1))
        self._scorer.load_depth(depth)
        self._scorer.place(centre)
        clock.lap("predict")
        found, error = self._search(pose, self._first_swarm(origins))
        self._pose = found
        clock.lap("fit")
        return Estimate(
            pose=found,
            depth_error=error,
            found=error < self.config.lost_error,
            timings=clock.spans,
        )

    def _first_swarm(self, origins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Increments about the first origin, shape (particles, 27), drawn around each in turn.

        Args:
            origins: Poses to draw around, shape (n, 28), each of them itself in the swarm.
        """
        count, number = self.config.particles, len(origins)
        swarm = self._rng.normal(0.0, self._spread, (count, NV))
        swarm[:number] = 0.0
        drawn = apply_increment(origins[np.arange(count) % number], swarm)
        return pose_difference(drawn, origins[0])

    def _search(
        self, pose: NDArray[np.float64], swarm: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """Best pose that a swarm about `pose` sees, shape (28,), and its depth error [m].

        Args:
            pose: Pose that positions in the swarm are increments of, shape (28,).
            swarm: First positions, shape (particles, 27).
        """
        config, rng = self.config, self._rng
        low, high = np.full((2, NV), np.inf) * [[-1.0], [1.0]]
        low[6:], high[6:] = (self._hand.limits - pose[7:, None]).T
        at = np.clip(swarm, low, high)
        velocity = np.zeros_like(at)
        best, best_cost = at.copy(), np.full(len(at), np.inf)
        best_error = best_cost.copy()
        leader = 0
        for generation in range(config.generations):
            if generation > 0:
                own, shared = rng.random((2, *at.shape))
                velocity += config.cognitive * own * (best - at)
                velocity += config.social * shared * (best[leader] - at)
                velocity *= config.constriction
                moved = at + velocity
                at = np.clip(moved, low, high)
                # Whoever has run against a limit does not go on pushing.
                velocity[at != moved] = 0.0
                if config.redraw_period and generation % config.redraw_period == 0:
                    self._redraw_angles(at, velocity, low, high)
            error, cost = self._score(apply_increment(pose, at))
            better = cost < best_cost
            best[better], best_cost[better], best_error[better] = (
                at[better], cost[better], error[better],
            )  # fmt: skip
            leader = int(np.argmin(best_cost))
        return apply_increment(pose, best[leader]), float(best_error[leader])

    def _redraw_angles(
        self, at: NDArray[np.float64], velocity: NDArray[np.float64],
        low: NDArray[np.float64], high: NDArray[np.float64],
    ) -> None:  # fmt: skip
        """Give one joint of some particles another angle, at rest; in place.

        Args:
            at: Positions, shape (particles, 27).
            velocity: Velocities, shape (particles, 27).
            low: Lower bounds of positions, shape (27,).
            high: Upper bounds of positions, shape (27,).
        """
        rng, count = self._rng, len(at)
        chosen = rng.permutation(count)[: round(self.config.redraw_share * count)]
        angles = rng.integers(6, NV, size=len(chosen))
        at[chosen, angles] = rng.uniform(low[angles], high[angles])
        velocity[chosen, angles] = 0.0

    def _score(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Depth errors of poses [m], and what the swarm minimises [m], each shape (particles,)."""
        self._scorer.set_poses(poses)
        self._scorer.run()
        errors = self._scorer.errors.astype(np.float64)
        crossed = crossed_angles(self._hand, poses[:, 7:])
        return errors, errors + self.config.crossing_weight * crossed
