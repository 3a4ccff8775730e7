"""`handtrack grasp`: plan how to take an object, and carry it out under physics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from handtrack.grasp.plan import GraspPlan
    from handtrack.grasp.run import GraspRun
    from handtrack.hand.model import ShapedHand
    from handtrack.objects.rigid_object import RigidObject


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOptions:
    """Plan how a hand takes an object, and carry it out under physics.

    OBJECT is one of the library (--list names them) or a closed mesh file. It stands on a table;
    the hand takes it, brings it where --to says and holds it there, or lets it go with --release.

    Examples::

        handtrack grasp apple --video apple.mp4
        handtrack grasp cup --grip tripod --to 0.2,0.1,0.1 --json cup.json
        handtrack grasp teapot.obj --scale 0.001 --mass 0.4 --plan teapot.npz --no-physics
    """

    object: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="OBJECT")] = None
    """Name of an object of the library, or a mesh file."""
    list: bool = False
    """Print the names of objects and grip modes, and do nothing else."""
    grip: str = "auto"
    """Grip mode; auto chooses."""
    to: str = "0.25,0,0.15"
    """Where to bring it from where it stands: x,y,z [m], z up, and perhaps its turn about the
    vertical [degrees]."""
    release: bool = False
    """Let go of the object at the target."""
    yaw: float = 0.0
    """How the object is turned about the vertical at first [degrees]."""
    side: Literal["right", "left"] = "right"
    """Which hand."""
    shape: Path | None = None
    """Shape of the hand, as fit-shape writes it; the mean hand without."""
    mass: float | None = None
    """Mass of the object [kg]."""
    friction: float | None = None
    """Its friction against skin; 0.8 without."""
    scale: float = 1.0
    """A mesh file is made so many times as large; 0.001 for millimetres."""
    controller: Literal["full", "pd", "pollard-zordan"] = "full"
    """What drives the hand under physics."""
    physics: bool = True
    """Whether the plan is carried out; with --no-physics it is only made."""
    plan: Path | None = None
    """Write the plan to this .npz file."""
    json: Path | None = None
    """Write what came of it to this file."""
    video: Path | None = None
    """Write a video (.mp4, .webm, .gif) of what happens, or of the plan without physics."""
    mjcf: Path | None = None
    """Write the world with the hand closed on the object as MJCF, which MuJoCo's viewer opens."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of the search."""


def run(options: GraspOptions) -> int:
    """Plan, simulate, print, write.

    Args:
        options: The command's options.

    Returns:
        Exit code 0, whether or not the object is held.

    Raises:
        HandtrackError: An option or file is unusable, or no grasp is found.
    """
    # Imported here: `handtrack --help` need not wait for Warp.
    import time

    import numpy as np

    from handtrack.cli import compute_device
    from handtrack.errors import InputError
    from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig
    from handtrack.grasp.taxonomy import grip_mode
    from handtrack.objects.distance_field import DistanceField

    if options.list:
        _print_names()
        return 0
    if options.object is None:
        raise InputError("name an object or a mesh file; handtrack grasp --list names the objects")
    for path in (options.plan, options.json, options.video, options.mjcf):
        if path is not None and not path.resolve().parent.is_dir():
            raise InputError(f"{path.resolve().parent} is no folder: create it first")
    if options.grip != "auto":
        grip_mode(options.grip)  # before anything is loaded
    way = _way(options.to)
    thing, hand = _object(options), _hand(options)
    device = compute_device(options.device).alias
    distances = DistanceField.of(thing, device=device)
    half = 0.5 * np.deg2rad(options.yaw)
    place = np.array([0.0, 0.0, thing.rest_height, np.cos(half), 0.0, 0.0, np.sin(half)])
    target = place.copy()
    target[:3] += way[:3]
    half += 0.5 * np.deg2rad(way[3])
    target[3:] = [np.cos(half), 0.0, 0.0, np.sin(half)]
    planner = GraspSynthesizer(hand, config=SynthesisConfig(release=options.release), device=device)
    started = time.perf_counter()
    plan = planner.plan(
        thing, grip=options.grip, place=place, target=target, distances=distances,
        seed=options.seed,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    if options.plan is not None:
        plan.save(options.plan)
    if options.mjcf is not None:
        _write_mjcf(options.mjcf, hand, thing, plan)
    found = None
    if options.physics:
        from handtrack.grasp.simulation import simulate

        found = simulate(plan, thing, hand=hand, controller=options.controller, distances=distances)
    facts = _facts(thing, plan, found, seconds, options.controller)
    if options.json is not None:
        _write_json(options.json, facts)
    _print(facts)
    if options.video is not None:
        _write_video(options.video, hand, thing, plan, found, device)
    return 0


def _way(text: str) -> list[float]:
    """The option --to as x, y, z [m] and a turn [degrees]."""
    from handtrack.errors import InputError

    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4):
        raise InputError(f"--to is {text!r}: expected x,y,z or x,y,z,turn, such as 0.25,0,0.15")
    return [*numbers, 0.0][:4]


def _object(options: GraspOptions) -> RigidObject:
    """The object of the library or file, with the mass and friction asked for."""
    from handtrack.errors import InputError
    from handtrack.objects.library import DATABASE_OBJECTS, TEST_OBJECTS, load_object
    from handtrack.objects.rigid_object import RigidObject

    name = str(options.object)
    if name in (*DATABASE_OBJECTS, *TEST_OBJECTS):
        if options.scale != 1.0:
            raise InputError("--scale is for mesh files; objects of the library have their size")
        thing = load_object(name)
        if options.mass is not None:
            thing = replace(thing, mass=options.mass)
    elif Path(name).suffix:
        thing = RigidObject.from_mesh(Path(name), mass=options.mass, scale=options.scale)
    else:
        raise InputError(
            f"there is no object {name!r}: expected a mesh file or one of "
            f"{', '.join((*TEST_OBJECTS, *DATABASE_OBJECTS))}"
        )
    return thing if options.friction is None else replace(thing, friction=options.friction)


def _hand(options: GraspOptions) -> ShapedHand:
    """The hand asked for."""
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape

    shape = None if options.shape is None else HandShape.load(options.shape)
    return HandModel.load().shaped(shape, side=options.side)


def _facts(
    thing: RigidObject, plan: GraspPlan, run: GraspRun | None, seconds: float, controller: str
) -> dict[str, Any]:
    """What came of it, in plain numbers."""
    import numpy as np

    facts: dict[str, Any] = {
        "object": thing.name, "mass_kg": thing.mass, "friction": thing.friction, "grip": plan.grip,
        "contacts": len(plan.contact_bones), "synthesis_s": seconds,
        "planned_s": float(plan.times[-1]), "costs": dict(plan.costs),
    }  # fmt: skip
    if run is not None:
        held = bool(np.isfinite(run.position_error))
        facts |= {
            "controller": controller, "success": run.success, "failure": run.failure,
            "lift_mm": 1e3 * run.lift, "carry_mm": 1e3 * run.carry,
            "position_error_mm": 1e3 * run.position_error if held else None,
            "rotation_error_deg": float(np.rad2deg(run.rotation_error)) if held else None,
            "placed_error_mm": 1e3 * run.placed_error,
            "penetration_mm": 1e3 * run.penetration, "realtime_factor": run.realtime_factor,
        }  # fmt: skip
    return facts


def _print(facts: dict[str, Any]) -> None:
    """A table of the facts."""
    from rich.console import Console

    from handtrack.evaluation.report import terminal_table

    rows = []
    for name, value in facts.items():
        if name == "costs" or (name == "failure" and value is None):
            continue
        shown = f"{value:.3g}" if isinstance(value, float) else str(value)
        rows.append([name.replace("_", " "), "-" if value is None else shown])
    Console(highlight=False, width=1000).print(terminal_table("", ["", ""], rows))


def _print_names() -> None:
    """Names of objects and grip modes."""
    from handtrack.grasp.taxonomy import GRIPS
    from handtrack.objects.library import DATABASE_OBJECTS, TEST_OBJECTS

    print("objects:", ", ".join(TEST_OBJECTS))
    print("objects of the database:", ", ".join(DATABASE_OBJECTS))
    print("grip modes:", ", ".join(GRIPS))


def _write_json(path: Path, facts: dict[str, Any]) -> None:
    import json

    path.write_text(json.dumps(facts, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _write_mjcf(path: Path, hand: ShapedHand, thing: RigidObject, plan: GraspPlan) -> None:
    """The simulated world in the frame of the grasp."""
    from handtrack.physics.scene import Scene

    scene = Scene(hand, [thing])
    scene.set_hand(plan.hand_poses[plan.grasp_frame])
    scene.set_object(0, plan.object_poses[plan.grasp_frame])
    scene.save(path)


def _write_video(
    path: Path, hand: ShapedHand, thing: RigidObject, plan: GraspPlan, run: GraspRun | None,
    device: str,
) -> None:  # fmt: skip
    """A video of the simulation, or of the plan."""
    import numpy as np

    from handtrack.viewer.grasp_view import GraspPainter
    from handtrack.viewer.video import VideoWriter

    source = plan if run is None else run
    painter = GraspPainter(hand, [thing], device=device)
    rate = 30.0
    times = np.arange(source.times[0], source.times[-1], 1.0 / rate)
    frames = np.searchsorted(source.times, times).clip(0, len(source.times) - 1)
    with VideoWriter(path, frames_per_second=rate) as video:
        for k in frames.tolist():
            video.write(painter.paint(source.hand_poses[k], [source.object_poses[k]]))
