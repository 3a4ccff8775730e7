"""Trials of the suite `grasp`: plan, simulate, and put many together into one case."""

from __future__ import annotations

import copy
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.evaluation.suites.suite import SuiteSettings
from handtrack.grasp.controller import Variant
from handtrack.grasp.obstacles import Obstacle
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.run import GraspRun
from handtrack.grasp.simulation import FallingBall, simulate
from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from handtrack.physics.bone_solids import bone_solids

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """One synthesis."""

    name: str
    """Name of the object."""
    key: tuple[str, int] | None
    """Object and number of an attempt with all defaults; None for others."""
    plan: GraspPlan | None
    """The plan; None where no grasp was found."""
    reason: str = ""
    """Why there is none."""
    seconds: float
    """Time that the synthesis took [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One synthesis and what came of it under physics."""

    attempt: Attempt
    """The synthesis."""
    run: GraspRun | None
    """The simulation; None where there was no plan."""

    @property
    def failure(self) -> str | None:
        """What went wrong; None for a success."""
        return self.attempt.reason if self.run is None else self.run.failure


class GraspBench:
    """Hand, objects and synthesizer that all trials share."""

    def __init__(self, settings: SuiteSettings, data: Mapping[str, Any]) -> None:
        """Load, learn, and run one synthesis so that kernels are compiled before any is timed."""
        self.hand = HandModel.load().shaped()
        self.solids = bone_solids(self.hand)
        self._seed = [settings.seed, int(data["seed"])]
        self._carry = np.asarray(data["carry"], np.float64)
        self._device = settings.device
        self._attempts: dict[tuple[str, int], Attempt] = {}
        self._trials: dict[tuple[str, int, Variant], Trial] = {}
        self._things: dict[str, tuple[RigidObject, DistanceField]] = {}
        self._grip = data["grip"]
        self._planner = GraspSynthesizer(self.hand, device=self._device)
        self._warm_up = str(data["objects"][0])
        self.attempt(self._warm_up, -1, grip=self._grip)

    def with_hand(self, hand: ShapedHand) -> GraspBench:
        """The same bench for another hand; objects and what was learnt are shared."""
        bench = copy.copy(self)
        bench.hand, bench.solids = hand, bone_solids(hand)
        bench._attempts, bench._trials = {}, {}
        bench._planner = bench.synthesizer(self._planner.config)
        bench.attempt(bench._warm_up, -1, grip=bench._grip)
        return bench

    def synthesizer(self, config: SynthesisConfig) -> GraspSynthesizer:
        """A synthesizer of these settings, which learns nothing anew."""
        return GraspSynthesizer(
            self.hand, database=self._planner.database, model=self._planner.model, config=config,
            device=self._device,
        )  # fmt: skip

    def thing(self, name: str) -> RigidObject:
        """An object of the library."""
        return self._known(name)[0]

    def distances(self, name: str) -> DistanceField:
        """Its signed distances."""
        return self._known(name)[1]

    def attempt(
        self,
        name: str,
        number: int,
        *,
        grip: str | None = None,
        planner: GraspSynthesizer | None = None,
        place: Float | None = None,
        target: Float | None = None,
        hand: Float | None = None,
        obstacles: Sequence[Obstacle] = (),
    ) -> Attempt:
        """Synthesise a grasp; the same one is not synthesised twice.

        Args:
            name: Object of the library.
            number: Number of the trial; gives the seed and how the object is turned.
            grip: Grip mode or "auto"; the suite's own without.
            planner: Synthesizer; the default one without.
            place: Pose of the object, shape (7,); turned about the vertical at the origin without.
            target: Where to bring it, shape (7,); beside and above without.
            hand: Where the hand starts, shape (28,).
            obstacles: What else is there.
        """
        default = planner is None and grip is None and place is None and target is None
        key = (name, number) if default and hand is None else None
        if key is not None and key in self._attempts:
            return self._attempts[key]
        thing, distances = self._known(name)
        rng = np.random.default_rng([*self._seed, number + 1])
        if place is None:
            half = 0.5 * rng.uniform(-np.pi, np.pi)
            place = np.array([0.0, 0.0, thing.rest_height, np.cos(half), 0.0, 0.0, np.sin(half)])
        if target is None:
            target = place.copy()
            target[:3] += self._carry
        started, plan, reason = time.perf_counter(), None, ""
        try:
            plan = (planner or self._planner).plan(
                thing, grip=grip or self._grip, start=hand, place=place, target=target,
                obstacles=obstacles, distances=distances, seed=int(rng.integers(2**31)),
            )  # fmt: skip
        except InputError as error:
            reason = str(error)
        attempt = Attempt(
            key=key, name=name, plan=plan, reason=reason, seconds=time.perf_counter() - started
        )
        if key is not None:
            self._attempts[key] = attempt
        return attempt

    def trial(
        self,
        attempt: Attempt,
        controller: Variant,
        *,
        thing: RigidObject | None = None,
        balls: Sequence[FallingBall] = (),
    ) -> Trial:
        """Carry a plan out; what was carried out before is not again.

        Args:
            attempt: The synthesis.
            controller: What drives the hand.
            thing: Object in the world, where it is another than the plan's.
            balls: Balls that fall on it.
        """
        if attempt.plan is None:
            return Trial(attempt=attempt, run=None)
        there = self.thing(attempt.name) if thing is None else thing
        usual = attempt.key is not None and there is self.thing(attempt.name) and not balls
        key = (*attempt.key, controller) if usual and attempt.key is not None else None
        if key is not None and key in self._trials:
            return self._trials[key]
        run = simulate(
            attempt.plan, there, hand=self.hand, controller=controller, balls=balls,
            distances=self._known(there.name)[1], solids=self.solids,
        )  # fmt: skip
        trial = Trial(attempt=attempt, run=run)
        if key is not None:
            self._trials[key] = trial
        return trial

    def _known(self, name: str) -> tuple[RigidObject, DistanceField]:
        if name not in self._things:
            thing = load_object(name)
            self._things[name] = thing, DistanceField.of(thing, device=self._device)
        return self._things[name]


def case_of(case: str, controller: str, trials: Sequence[Trial]) -> dict[str, Any]:
    """One case of the benchmark file."""
    runs = [trial.run for trial in trials if trial.run is not None]
    plans = [trial.attempt.plan for trial in trials if trial.attempt.plan is not None]
    out: dict[str, Any] = {
        "case": case,
        "tracker": controller,
        "frames": len(trials),
        "trials": len(trials),
        "success_rate": float(np.mean([trial.failure is None for trial in trials])),
        "synthesis_ms": spread([1e3 * trial.attempt.seconds for trial in trials]),
        "failures": [
            f"{trial.attempt.name}: {trial.failure}"
            for trial in trials
            if trial.failure is not None
        ],
    }
    if runs:
        out |= {
            "penetration_mm": spread([1e3 * run.penetration for run in runs]),
            "lift_mm": spread([1e3 * run.lift for run in runs]),
            "realtime_factor": float(np.median([run.realtime_factor for run in runs])),
            **_force_times(runs),
            "grips": dict(Counter(plan.grip for plan in plans)),
        }
        # A trial that never came to hold has no errors there.
        held = [run for run in runs if np.isfinite(run.position_error)]
        if held:
            out |= {
                "position_error_mm": spread([1e3 * run.position_error for run in held]),
                "rotation_error_deg": spread([np.rad2deg(run.rotation_error) for run in held]),
            }
    return out


def _force_times(runs: Sequence[GraspRun]) -> dict[str, dict[str, float]]:
    """Time of the contact force program, of controllers that solve it."""
    times = np.concatenate([run.force_times for run in runs])
    return {"forces_ms": spread(1e3 * times)} if len(times) else {}


def spread(values: ArrayLike) -> dict[str, float]:
    """Mean, median and largest of some numbers."""
    found = np.asarray(values, np.float64)
    return {"mean": found.mean(), "median": float(np.median(found)), "max": found.max()}
