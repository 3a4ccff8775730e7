"""Make the videos of grasping in docs/videos: synthesised grasps, carried out under physics.

grasps.webp shows four objects taken, carried aside and held; stacking.webp three blocks stacked;
kitchen_table.webp a set table of which some things are taken and put elsewhere. Nothing is driven
but the hand. Where a grasp fails, another seed is tried, and said so.

Usage: python tools/make_grasp_videos.py [--out docs/videos] [--device cpu] [--only stacking]
       (some minutes; needs the extra `physics`)
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.grasp.run import Goal, GraspRun
from handtrack.grasp.sequence import Move, plan_sequence, waiting_pose
from handtrack.grasp.simulation import SimulationConfig, simulate, simulate_sequence
from handtrack.grasp.synthesis import GraspSynthesizer, SynthesisConfig
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from handtrack.physics.bone_solids import bone_solids
from handtrack.viewer.grasp_view import GraspPainter, GraspStyle
from handtrack.viewer.pictures import Image, contact_sheet
from handtrack.viewer.video import VideoWriter

Float = NDArray[np.float64]

RATE = 15.0
"""Frames per second of a video, in simulated, that is real, time."""
QUALITY = 75
CLEAR_HEIGHT = 0.12
"""How far what is put elsewhere rises over where it comes from and goes [m]."""
ATTEMPTS = 8
"""Seeds that are tried."""
HELD = ("apple", "cup", "banana", "bunny")
"""Objects of the first video."""
PANEL = GraspStyle(panel=(280, 280), span=0.62, centre=(0.085, -0.05, 0.13))
"""How each of its panels looks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrangement:
    """Things on a table, and what is to be done with them."""

    things: tuple[str, ...]
    """Names of objects."""
    places: tuple[tuple[float, float, float], ...]
    """Where each stands: x, y [m] and its turn about the vertical [degrees]."""
    moves: tuple[tuple[int, tuple[float, float, float]], ...]
    """Which object goes where: x, y and height of the underside [m]."""
    within: float
    """How near to its goal everything must lie at the end [m]."""
    style: GraspStyle
    """How it looks."""


STACKING = Arrangement(
    things=("cube_50",) * 3,
    places=((0.0, 0.0, 0.0), (0.0, 0.22, 0.0), (0.0, -0.22, 0.0)),
    moves=((0, (0.37, 0.0, 0.001)), (1, (0.30, 0.0, 0.001)), (2, (0.335, 0.0, 0.051))),
    within=0.005,
    style=GraspStyle(panel=(400, 300), span=0.8, centre=(0.11, -0.02, 0.12)),
)  # fmt: skip
KITCHEN = Arrangement(
    things=("cup", "apple", "bottle", "can", "banana", "cylinder_75_60", "goblet"),
    places=(
        (0.0, 0.18, 180.0), (0.0, -0.01, 0.0), (-0.08, 0.38, 0.0), (0.08, 0.38, 0.0),
        (0.0, -0.22, 90.0), (0.45, 0.06, 0.0), (0.45, -0.2, 0.0),
    ),
    moves=(
        (1, (0.25, -0.23, 0.001)), (0, (0.27, 0.11, 0.001)), (4, (0.27, -0.07, 0.001)),
        (3, (0.03, -0.08, 0.001)),
    ),
    within=0.03,
    style=GraspStyle(
        panel=(400, 300), span=0.95, distance=1.4, rise=32.0, centre=(0.09, -0.02, 0.05)
    ),
)  # fmt: skip


class Studio:
    """Hand, synthesizer and objects that all videos share."""

    def __init__(self, device: str | None) -> None:
        """Load and learn.

        Args:
            device: "cpu", "cuda:N" or None for the best there is.
        """
        self._device = device
        self._planner = GraspSynthesizer(device=device)
        self.hand = self._planner.hand
        self._solids = bone_solids(self.hand)

    def held(self, name: str) -> tuple[RigidObject, GraspRun]:
        """An object, and how it is taken, carried aside and held."""
        thing = load_object(name)
        distances = DistanceField.of(thing, device=self._device)
        start = waiting_pose(self._planner, (0.0, 0.0, thing.rest_height))
        for seed in range(ATTEMPTS):
            try:
                plan = self._planner.plan(thing, start=start, distances=distances, seed=seed)
            except InputError as error:
                print(f"{name}, seed {seed}: {error}")
                continue
            run = simulate(plan, thing, hand=self.hand, distances=distances, solids=self._solids)
            if run.failure is None:
                return thing, run
            print(f"{name}, seed {seed}: {run.failure}")
        raise SystemExit(f"no grasp of {name} holds")

    def rearranged(self, task: Arrangement) -> tuple[list[RigidObject], list[GraspRun]]:
        """The things, and a run for every move."""
        known = {name: load_object(name) for name in task.things}
        fields = {n: DistanceField.of(thing, device=self._device) for n, thing in known.items()}
        things = [replace(known[n], name=f"{n}_{k}") for k, n in enumerate(task.things)]
        starts = np.array([
            _standing(thing, *place) for thing, place in zip(things, task.places, strict=True)
        ])  # fmt: skip
        goals, moves = starts.copy(), []
        for index, (x, y, under) in task.moves:
            goals[index, :3] = x, y, things[index].rest_height + under
            moves.append(Move(index=index, target=goals[index].copy()))
        planner = GraspSynthesizer(
            self.hand, database=self._planner.database, model=self._planner.model,
            config=SynthesisConfig(release=True, clear_height=CLEAR_HEIGHT),
            device=self._device,
        )  # fmt: skip
        config = SimulationConfig(goal=Goal(hold=0.3))
        for seed in range(ATTEMPTS):
            seeded = [replace(m, seed=len(moves) * seed + k) for k, m in enumerate(moves)]
            try:
                plans = plan_sequence(
                    planner, things, starts, seeded, end=waiting_pose(planner, starts[0]),
                    distances=[fields[n] for n in task.things],
                )  # fmt: skip
            except InputError as error:
                print(f"seed {seed}: {error}")
                continue
            runs, ends = simulate_sequence(
                plans, things, starts, hand=self.hand, config=config, solids=self._solids
            )
            away = np.linalg.norm(ends[:, :3] - goals[:, :3], axis=1)
            off = ", ".join(
                f"{thing.name} {1000 * d:.0f} mm" for thing, d in zip(things, away, strict=True)
            )
            print(f"seed {seed}, from their goals: {off}")
            if (away <= task.within).all():
                return things, runs
        raise SystemExit("no seed puts everything where it belongs")


def main() -> None:
    """Make all videos, or one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("--out", type=Path, default=root / "docs" / "videos")
    parser.add_argument("--device", default=None)
    parser.add_argument("--only", choices=("grasps", "stacking", "kitchen_table"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    studio = Studio(options.device)
    if options.only in (None, "grasps"):
        panels = [grasp_pictures(studio, name) for name in HELD]
        # Who is done first waits for the others.
        last = max(len(pictures) for pictures in panels)
        frames = [
            contact_sheet([pictures[min(k, len(pictures) - 1)] for pictures in panels], 2)
            for k in range(last)
        ]
        write(options.out / "grasps.webp", frames)
    for name, task in {"stacking": STACKING, "kitchen_table": KITCHEN}.items():
        if options.only in (None, name):
            things, runs = studio.rearranged(task)
            painter = GraspPainter(studio.hand, things, style=task.style)
            frames = [picture for run in runs for picture in pictures_of(run, painter)]
            write(options.out / f"{name}.webp", frames)


def grasp_pictures(studio: Studio, name: str) -> list[Image]:
    """How one object is taken and held, its name on every picture."""
    thing, run = studio.held(name)
    pictures = pictures_of(run, GraspPainter(studio.hand, [thing], style=PANEL))
    for picture in pictures:
        cv2.putText(
            picture, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA
        )
    return pictures


def pictures_of(run: GraspRun, painter: GraspPainter) -> list[Image]:
    """Pictures of a run at the video's rate."""
    times = np.arange(run.times[0], run.times[-1], 1.0 / RATE)
    frames = np.searchsorted(run.times, times).clip(0, len(run.times) - 1)
    return [painter.paint(run.hand_poses[k], run.scene_poses[k]) for k in frames]


def write(path: Path, pictures: Sequence[Image]) -> None:
    """Write a video whose last picture stays a second, and say how large it is."""
    with VideoWriter(path, frames_per_second=RATE, quality=QUALITY) as video:
        for picture in [*pictures, *[pictures[-1]] * round(RATE)]:
            video.write(picture)
        seconds = video.count / RATE
    print(f"{path}: {seconds:.1f} s, {path.stat().st_size / 1e6:.2f} MB")


def _standing(thing: RigidObject, x: float, y: float, turn: float) -> Float:
    half = 0.5 * np.deg2rad(turn)
    return np.array([x, y, thing.rest_height, np.cos(half), 0.0, 0.0, np.sin(half)])


if __name__ == "__main__":
    main()
