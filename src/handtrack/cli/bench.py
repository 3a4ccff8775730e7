"""`handtrack bench`: accuracy and speed, measured together in one run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

if TYPE_CHECKING:
    from collections.abc import Iterable
    from collections.abc import Sequence as Frames

    from rich.console import Console

    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.sequence import Sequence
    from handtrack.evaluation.suites.suite import RecordedFrames, SuiteResult


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOptions:
    """Measure accuracy and speed together: one table, and a file with every number.

    SUITE is one of selftest (two fists, self-occlusion, no noise), tracking (recorded motion with
    forearm and noise, three subjects), single-frame (no memory: unseen subjects, any viewpoint),
    recovery (frames until tracking is back from a scrambled pose), scenes (people, a hand that
    leaves, a cup instead of a hand), speed (time per frame and stage by number of hypotheses),
    live (a camera for --minutes: memory, dropped frames, age of results), viewer (what the web
    viewer costs the loop), ablation (every switch changed), regression (the
    forest alone), shape (fitted to images and while tracking), grasp (unseen objects grasped under
    physics; its trackers are the controllers full, pd and pollard-zordan), real (labelled real
    images, --data); --sequence measures any recorded sequence.

    Trackers that find the hand by themselves are never given a pose.

    Examples::

        handtrack bench selftest --json selftest.json
        handtrack bench tracking --tracker model_based --tracker thesis --curves curves/
        handtrack bench tracking --tracker model_based --first-pose found --shape mean
        handtrack bench single-frame --tracker hybrid --pictures pictures/
        handtrack bench grasp --quick
        handtrack bench real --data recordings/ --pictures pictures/
        handtrack bench --sequence data/demo.npz --tracker model_based --tracker thesis
    """

    suite: Annotated[
        Literal[
            "selftest",
            "tracking",
            "single-frame",
            "recovery",
            "scenes",
            "speed",
            "live",
            "viewer",
            "ablation",
            "regression",
            "shape",
            "grasp",
            "real",
            "sequence",
        ]
        | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="SUITE"),
    ] = None
    """What to measure; may be left out with --sequence."""
    tracker: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Tracker to measure; repeat the option to compare several. The suite's own when not given."""
    stride: Annotated[tuple[int, ...], tyro.conf.UseAppendAction] = ()
    """Take every so many frames only; repeat the option for several. The suite's own without."""
    subject: Annotated[tuple[int, ...], tyro.conf.UseAppendAction] = ()
    """Seed of a subject; repeat the option for several. The suite's own without."""
    section: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Suite grasp: run a part only: objects, grips, ablation, controllers, robustness or stacking;
    repeat the option for several."""
    sequence: str | None = None
    """Recorded sequence to track: file or folder."""
    start: str = "truth"
    """First pose of --sequence: truth (its labels), or a .json or .npz file with 28 numbers."""
    first_pose: Literal["truth", "found"] = "truth"
    """Suite tracking: first pose of each take for trackers that need one, the true one, or what the
    automatic tracker finds in that frame without memory."""
    side: Literal["right", "left"] | None = None
    """Hand of --sequence; without it what the sequence says, else right."""
    shape: Literal["given", "mean", "fitted", "adapted"] | None = None
    """Give trackers the subject's shape, or let them make do with the mean hand. The suite's own
    when not given: mean for single-frame, recovery, scenes and real, given for the others. Suite
    tracking: fitted to images of the subject beforehand, or adapted while tracking."""
    data: Path | None = None
    """Folder with the recordings of others, for the suite real."""
    json: Path | None = None
    """Write every number to this file."""
    format: Literal["human", "short", "json"] = "human"
    """What is printed: tables, one line per case, or what --json would write."""
    curves: Path | None = None
    """Folder for pictures of error curves; made when it does not exist."""
    pictures: Path | None = None
    """Folder for overlay pictures of single-frame, scenes, real and sequence; made when it does not
    exist."""
    quick: bool = False
    """Run a small part only, to see that everything works; its numbers mean little."""
    cold: bool = False
    """Suite speed: time the start with all kernels to compile too, which takes minutes."""
    minutes: float | None = None
    """Suite live: how long it runs; 10 without."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of the sensor noise and of the trackers."""


def run(options: BenchOptions) -> int:
    """Measure, print, write what was asked for.

    Args:
        options: The command's options.

    Returns:
        Exit code 0, whether or not the suite's targets are met.

    Raises:
        HandtrackError: An option or a file is unusable.
    """
    # Imported here: `handtrack --help` need not wait for Warp.
    from handtrack.cli import compute_device
    from handtrack.cli.progress import progress
    from handtrack.errors import InputError
    from handtrack.evaluation.report import bench_document
    from handtrack.evaluation.suites.suite import SuiteSettings, run_suite

    suite = options.suite or ("sequence" if options.sequence is not None else None)
    if suite is None:
        raise InputError("name a suite (handtrack bench --help lists them) or a --sequence PATH")
    if (options.sequence is None) == (suite == "sequence"):
        raise InputError("--sequence PATH goes with the suite sequence, and only with it")
    if options.json is not None and not options.json.resolve().parent.is_dir():
        raise InputError(f"{options.json.resolve().parent} is no folder: create it first")
    device = compute_device(options.device)
    settings = SuiteSettings(
        trackers=options.tracker, subjects=options.subject, strides=options.stride,
        sections=options.section,
        device=device.alias, seed=options.seed, quick=options.quick,
        shape=options.shape, first_pose=options.first_pose, data=options.data, cold=options.cold,
        minutes=options.minutes, progress=progress,
    )  # fmt: skip
    if options.sequence is None:
        result = run_suite(suite, settings)
    else:
        from handtrack.camera.source import open_sequence

        with open_sequence(options.sequence) as sequence:
            result = run_suite(suite, replace(settings, sequence=_recorded(sequence, options)))
    document = bench_document(
        result.suite, f"{device.alias} ({device.name})", result.cases,
        command=_command(options), quick=options.quick,
        targets=[target.to_dict() for target in result.targets], notes=result.notes,
        **result.more,
    )  # fmt: skip
    if options.json is not None:
        options.json.write_text(_json(document), encoding="utf-8")
    _print(options, result, document)
    if options.curves is not None:
        _draw_curves(options.curves, result)
    if options.pictures is not None:
        _draw_overlays(options.pictures, result)
    return 0


def _recorded(sequence: Sequence, options: BenchOptions) -> RecordedFrames:
    """What trackers are told about an open sequence."""
    from handtrack.camera.sequence import RecordedSequence
    from handtrack.cli.first_pose import first_labelled, labelled_pose, read_pose
    from handtrack.cli.track import choose_shape, choose_side
    from handtrack.errors import InputError
    from handtrack.evaluation.suites.suite import RecordedFrames
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape

    if not isinstance(sequence, RecordedSequence) or not len(sequence):
        raise InputError(f"{options.sequence} holds no frame: expected a recording")
    model = HandModel.load()
    labelled = first_labelled(sequence)
    side = choose_side(options.side, sequence)
    wanted = "mean" if options.shape == "mean" else None
    shape, origin = choose_shape(wanted, sequence, labelled, model, side)
    if options.start != "truth":
        starts, told = {0: read_pose(Path(options.start))}, options.start
    elif labelled is not None and labelled.truth is not None:
        hand = model.shaped(shape, side=side)
        starts = {labelled.index: labelled_pose(labelled.truth, hand, model)}
        told = f"labels of frame {labelled.index}"
    else:
        # Whether that is enough depends on the tracker.
        starts, told = {}, "none"
    return RecordedFrames(
        # A recording has a length and numbered frames, all that a run asks of it.
        name=sequence.name, frames=cast("Frames[DepthFrame]", sequence), starts=starts, side=side,
        shape=shape or HandShape(), notes=(f"{side} hand; shape: {origin}; first pose: {told}",),
    )  # fmt: skip


def _print(options: BenchOptions, result: SuiteResult, document: dict[str, Any]) -> None:
    """Print the result in the format asked for."""
    from rich.console import Console

    if options.format == "json":
        print(_json(document), end="")
        return
    if options.format == "short":
        print("\n".join(_lines(result)))
        return
    # Tables get the width they need: squeezed into a terminal, they would lose the cases' names.
    console = Console(highlight=False, width=1000)
    _print_tables(console, result)
    versions = document["versions"]
    console.print(
        f"{document['device']}, {versions['cpu']}; handtrack {versions['handtrack']}"
        f"{' ' + versions['commit'] if 'commit' in versions else ''}, warp {versions['warp']}",
        soft_wrap=True,
    )


def _print_tables(console: Console, result: SuiteResult) -> None:
    """Accuracy and speed, stages, targets, notes."""
    from handtrack.evaluation.report import bench_rows, stage_rows, terminal_table

    console.print(terminal_table(f"suite {result.suite}", *bench_rows(result.cases)))
    several = len({case["tracker"] for case in result.cases}) > 1
    headers, rows = stage_rows(
        [case | {"case": f"{case['case']}, {case['tracker']}"} for case in result.cases]
        if several
        else result.cases
    )
    if rows:
        console.print(terminal_table("median time per stage", headers, rows))
    if result.targets:
        goals = [
            [
                "PASS" if target.passed else "MISS", target.case, target.tracker, target.value,
                f"{'at most' if target.at_most else 'at least'} {target.bound:g}",
                f"{target.reached:.4g}",
            ]
            for target in result.targets
        ]  # fmt: skip
        headers = ["", "case", "tracker", "number", "target", "reached"]
        console.print(terminal_table("targets", headers, goals))
    for note in result.notes:
        console.print(note, soft_wrap=True)


def _lines(result: SuiteResult) -> Iterable[str]:
    """One line per case, for scripts and logs."""
    from handtrack.evaluation.report import bench_rows

    headers, rows = bench_rows(result.cases)
    for row in rows:
        cells = zip(headers[2:], row[2:], strict=True)
        yield f"{row[0]} {row[1]}: " + ", ".join(f"{name} {cell}" for name, cell in cells)
    for target in result.targets:
        word = "PASS" if target.passed else "MISS"
        bound = f"{'<=' if target.at_most else '>='} {target.bound:g}"
        yield f"{word} {target.case} {target.value} {target.reached:.4g} {bound}"


def _draw_curves(folder: Path, result: SuiteResult) -> None:
    """Write the suite's own curves, the share of frames over the distance, the error over time."""
    from handtrack.evaluation.curves import (
        draw_curves,
        draw_errors_over_time,
        draw_success_curves,
        write_picture,
    )

    folder.mkdir(parents=True, exist_ok=True)
    for curves in result.curves:
        picture = draw_curves(
            curves.lines, curves.xlabel, curves.ylabel, curves.title, y_range=curves.y_range
        )
        write_picture(folder / f"{result.suite}-{curves.name}.png", picture)
    if not result.errors_mm:
        return
    title = f"{result.suite}: frames whose worst joint is within a distance"
    picture = draw_success_curves(result.errors_mm, title=title)
    write_picture(folder / f"{result.suite}-success.png", picture)
    for number, (name, errors) in enumerate(result.errors_mm.items()):
        title = f"{result.suite}: mean error of each frame, one run after the other"
        picture = draw_errors_over_time({name: errors}, title=title)
        write_picture(folder / f"{result.suite}-error-{number}.png", picture)


def _draw_overlays(folder: Path, result: SuiteResult) -> None:
    """Write every overlay as a picture."""
    from handtrack.evaluation.curves import write_picture
    from handtrack.viewer.pictures import OverlayPainter, PictureStyle

    folder.mkdir(parents=True, exist_ok=True)
    for overlay in result.overlays:
        painter = OverlayPainter(
            overlay.hand, overlay.camera, style=PictureStyle(zoom=overlay.zoom)
        )
        picture = painter.paint(
            overlay.depth, overlay.pose, title=overlay.name,
            lines=[(overlay.text, (240, 240, 240))], lost=overlay.lost,
        )  # fmt: skip
        write_picture(folder / f"{overlay.name}.png", picture)


def _command(options: BenchOptions) -> str:
    """The command line that gives the same numbers, without paths."""
    words = ["handtrack", "bench", options.suite or "--sequence"]
    if options.sequence is not None:
        words += ["--sequence"] * (options.suite is not None) + [Path(options.sequence).name]
    words += [word for name in options.tracker for word in ("--tracker", name)]
    if options.first_pose != "truth":
        words += ["--first-pose", options.first_pose]
    if options.shape is not None:
        words += ["--shape", options.shape]
    words += [word for number in options.stride for word in ("--stride", str(number))]
    words += [word for number in options.subject for word in ("--subject", str(number))]
    words += [word for name in options.section for word in ("--section", name)]
    if options.seed:
        words += ["--seed", str(options.seed)]
    words += ["--quick"] * options.quick + ["--cold"] * options.cold
    return " ".join([*words, "--device", options.device])


def _json(document: dict[str, Any]) -> str:
    """The benchmark file's text, as `handtrack.evaluation.report.write_bench` writes it."""
    import json

    return json.dumps(document, indent=1, allow_nan=False) + "\n"
