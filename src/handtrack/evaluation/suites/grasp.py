"""Suite `grasp`: grasps synthesised for objects that are not in the database, under physics.

The "tracker" of a case is the controller that drives the hand. A trial is one synthesis and one
simulation; one that finds no grasp counts as a failure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import chain, product
from typing import Any

import numpy as np

from handtrack.errors import InputError
from handtrack.evaluation.suites.grasp_trials import GraspBench, Trial, case_of, spread
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.grasp.closing import ClosingConfig
from handtrack.grasp.controller import VARIANTS, Variant
from handtrack.grasp.objective import ObjectiveConfig
from handtrack.grasp.sequence import joined, others, waiting_pose
from handtrack.grasp.simulation import FallingBall, simulate_sequence
from handtrack.grasp.synthesis import SynthesisConfig
from handtrack.hand.model import HandModel
from handtrack.objects.rigid_object import RigidObject

Cases = list[dict[str, Any]]


def grasp_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/grasp.toml`.

    Raises:
        InputError: A controller or section is unknown.
    """
    data = chosen(settings, cases)
    controllers: list[Variant] = [_variant(name) for name in data["trackers"]]
    for name in settings.sections:
        if name not in SECTIONS:
            raise InputError(f"section is {name!r}; expected one of {', '.join(SECTIONS)}")
    bench = GraspBench(settings, data)
    found: Cases = []
    for name, section in SECTIONS.items():
        part = data if name == "objects" else data.get(name)
        if part and (not settings.sections or name in settings.sections):
            found += section(bench, part, controllers, settings)
    return SuiteResult(
        suite="grasp", cases=found, targets=judged(found, data["targets"], controllers[0]),
        notes=[
            "success: lifted 10 cm, carried 20 cm, held 2 s within 2 cm and 15 degrees of the "
            "target, hand never over 3 mm deep; a trial without a grasp is a failure",
            "synthesis is timed without the object's distance field, which is measured once for "
            "every object",
        ],
    )  # fmt: skip


def _variant(name: str) -> Variant:
    for variant in VARIANTS:
        if variant == name:
            return variant
    raise InputError(f"controller is {name!r}; expected one of {', '.join(VARIANTS)}")


def _objects(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], settings: SuiteSettings
) -> Cases:
    """All objects, each grasped with whatever grip mode suits it."""
    names, count = data["objects"], int(data["trials"])
    found: dict[tuple[Variant, str], list[Trial]] = {}
    for name in settings.progress(names, len(names), "objects"):
        for controller in controllers:
            found[controller, name] = [
                bench.trial(bench.attempt(name, number), controller) for number in range(count)
            ]
    cases = []
    for controller in controllers:
        own = {name: trials for (who, name), trials in found.items() if who == controller}
        cases.append(case_of("all", controller, list(chain(*own.values()))))
        cubes = [trials for name, trials in own.items() if name.startswith("cube_")]
        if len(cubes) > 1:
            cases.append(case_of("cubes", controller, list(chain(*cubes))))
        cases += [case_of(name, controller, trials) for name, trials in own.items()]
    return cases


def _grips(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], settings: SuiteSettings
) -> Cases:
    """One object grasped with several grip modes (thesis Fig. III.7, bottom)."""
    cases, thing, grips = [], data["object"], data["names"]
    for grip in settings.progress(grips, len(grips), "grip modes"):
        attempts = [bench.attempt(thing, n, grip=grip) for n in range(int(data["trials"]))]
        trials = [bench.trial(attempt, controllers[0]) for attempt in attempts]
        cases.append(case_of(f"{thing}/{grip}", controllers[0], trials))
    return cases


def _hands(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], settings: SuiteSettings
) -> Cases:
    """Other people's hands, every other one a left hand; each one takes every object once."""
    model, trials = HandModel.load(), []
    numbers = range(int(data["count"]))
    for number in settings.progress(numbers, len(numbers), "hands"):
        rng = np.random.default_rng([settings.seed, int(data["seed"]), number])
        hand = model.shaped(model.sample_shape(rng), side=("right", "left")[number % 2])
        other = bench.with_hand(hand)
        trials += [
            other.trial(other.attempt(name, number), controllers[0]) for name in data["objects"]
        ]
    return [case_of("hands", controllers[0], trials)]


def _ablation(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], settings: SuiteSettings
) -> Cases:
    """Terms of the objective left out, one after the other (thesis III.8.1).

    Every plan is carried out in the world it was made for and in those of `worlds`, which tell
    grasps apart that all hold where nothing is unexpected.
    """
    cases = []
    tasks = list(product(data["objects"], range(int(data["trials"]))))
    for switch in data["switches"]:
        objective = ObjectiveConfig(**switch["objective"])
        planner = None
        if switch["objective"]:
            planner = bench.synthesizer(SynthesisConfig(closing=ClosingConfig(objective=objective)))
        found: dict[str, list[Trial]] = {}
        for name, number in settings.progress(tasks, len(tasks), switch["name"]):
            attempt = bench.attempt(name, number, planner=planner)
            for world in [{"name": "ablation"}, *data.get("worlds", [])]:
                thing = _changed(bench, name, world)
                trial = bench.trial(attempt, controllers[0], thing=thing)
                found.setdefault(world["name"], []).append(trial)
        cases += [
            case_of(f"{world}/{switch['name']}", controllers[0], trials)
            for world, trials in found.items()
        ]
    return cases


def _controllers(
    bench: GraspBench, data: Mapping[str, Any], _: list[Variant], settings: SuiteSettings
) -> Cases:
    """The same plans under every controller (thesis III.8.2)."""
    cases = []
    tasks = list(product(data["objects"], range(int(data["trials"]))))
    for variant in VARIANTS:
        trials = [
            bench.trial(bench.attempt(name, number), variant)
            for name, number in settings.progress(tasks, len(tasks), f"controller {variant}")
        ]
        cases.append(case_of("controllers", variant, trials))
    return cases


def _robustness(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], settings: SuiteSettings
) -> Cases:
    """Plans carried out in a world other than they were made for (thesis III.8.3)."""
    cases, changes = [], data["changes"]
    for change in settings.progress(changes, len(changes), "robustness"):
        thing = _changed(bench, change.get("instead", change["object"]), change)
        balls = [FallingBall(mass=change["ball_mass"])] if "ball_mass" in change else []
        attempts = [bench.attempt(change["object"], n) for n in range(int(data["trials"]))]
        trials = [
            bench.trial(attempt, controllers[0], thing=thing, balls=balls) for attempt in attempts
        ]
        cases.append(case_of(f"robustness/{change['name']}", controllers[0], trials))
    return cases


def _changed(bench: GraspBench, name: str, change: Mapping[str, Any]) -> RigidObject:
    """An object with the mass and friction that it has in another world."""
    thing = bench.thing(name)
    if "mass_times" in change:
        thing = replace(thing, mass=thing.mass * change["mass_times"])
    if "friction" in change:
        thing = replace(thing, friction=change["friction"])
    return thing


def _stacking(
    bench: GraspBench, data: Mapping[str, Any], controllers: list[Variant], _: SuiteSettings
) -> Cases:
    """Blocks stacked one after the other in one world (thesis Fig. III.8)."""
    thing = bench.thing(data["object"])
    planner = bench.synthesizer(
        SynthesisConfig(release=True, clear_height=float(data["clear_height"]))
    )
    level = [1.0, 0.0, 0.0, 0.0]
    starts = np.array([[*place, thing.rest_height, *level] for place in data["starts"]])
    goals = np.array([[*place, *level] for place in data["goals"]])
    goals[:, 2] += thing.rest_height
    # The hand comes to every block from the same side: blocks that stand must not be in its way.
    plans, attempts, places = [], [], starts.copy()
    fields = [bench.distances(data["object"])] * len(starts)
    for number, (start, goal) in enumerate(zip(starts, goals, strict=True)):
        attempt = bench.attempt(
            data["object"], number, planner=planner, place=start, target=goal,
            hand=waiting_pose(planner, start), obstacles=others(fields, places, number),
        )  # fmt: skip
        places[number] = goal
        attempts.append(attempt)
        if attempt.plan is None:
            break
        plans.append((number, attempt.plan))
    things = [replace(thing, name=f"{thing.name}_{k}") for k in range(len(starts))]
    runs, ends = simulate_sequence(
        joined(planner, plans), things, starts, hand=bench.hand, controller=controllers[0],
        solids=bench.solids,
    )  # fmt: skip
    trials = [
        Trial(attempt=attempt, run=run)
        for attempt, run in zip(attempts, [*runs, None][: len(attempts)], strict=True)
    ]
    case = case_of("stacking", controllers[0], trials)
    # Here every block must lie where it belongs when the last one has been let go of.
    away = np.linalg.norm(goals[:, :3] - ends[:, :3], axis=1)
    placed = {
        "off_mm": (1e3 * away).round(2),
        "frames": len(goals), "trials": len(goals), "position_error_mm": spread(1e3 * away),
        "success_rate": float((away <= data["within"]).mean()),
    }  # fmt: skip
    return [case | placed]


SECTIONS: dict[
    str, Callable[[GraspBench, Mapping[str, Any], list[Variant], SuiteSettings], Cases]
] = {
    "objects": _objects,
    "grips": _grips,
    "hands": _hands,
    "ablation": _ablation,
    "controllers": _controllers,
    "robustness": _robustness,
    "stacking": _stacking,
}
"""Parts of the suite, each with a table of that name in its file."""
