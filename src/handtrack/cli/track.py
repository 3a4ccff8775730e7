"""`handtrack track`: follow the hand through a recorded sequence and save the results."""

from __future__ import annotations

import hashlib
import json
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

if TYPE_CHECKING:
    from collections.abc import Iterator

    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.sequence import Sequence
    from handtrack.cli.first_pose import Pose
    from handtrack.evaluation.run_record import RunRecord
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape
    from handtrack.tracking.tracker import HandTracker

TrackerName = Literal["hybrid", "thesis_hybrid", "discriminative", "model_based", "thesis", "pso"]
"""Names in `handtrack.tracking.tracker.TRACKERS`, which is not imported for the help text."""

MEAN_HAND = "mean hand"
"""Where a shape comes from that nobody gave."""

WARM_UP = 2
"""Frames at the start that speed is not measured on: they load and capture the kernels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """Track the hand in a recorded depth sequence; write results.npz, results.csv, config.json.

    SOURCE is an .npz recording, a folder of 16-bit PNG images with camera.json, or a data set
    (NYU, MSRA, ICVL). The hand is found without being told where it is; trackers that cannot do
    that take the first pose from the labels of the sequence, or from --start.

    Examples::

        handtrack track data/demo.npz --out out/demo --video
        handtrack track recording/ --out out/run --side left --shape me.npz
        handtrack track recording/ --out out/run --tracker model_based --start first_pose.json
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Recorded sequence: file or folder."""
    out: Path
    """Folder for the results; made when it does not exist."""
    video: bool = False
    """Write overlay.mp4 too: mesh and keypoints over the depth."""
    zoom: float | None = None
    """Let the video show so many metres around the hand instead of the whole image."""
    tracker: TrackerName = "hybrid"
    """Which tracker: hybrid finds and follows the hand; the others are baselines."""
    shape: str | None = None
    """Hand shape: an .npz file, or mean; without it that of the sequence when it carries one."""
    side: Literal["right", "left"] | None = None
    """Which hand; without it what the sequence says, else right."""
    start: str = "auto"
    """First pose: auto (none for trackers that find the hand, else truth), truth (the labels of the
    sequence), or a .json or .npz file with 28 numbers."""
    format: Literal["npz", "png", "nyu", "msra", "icvl"] | None = None
    """Format of the sequence, told from its content when not given."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of whatever is random."""


def run(options: TrackOptions) -> int:
    """Track, print, write.

    Args:
        options: The command's options.

    Returns:
        Exit code: 0, or 130 when it was interrupted (what was tracked by then is written).

    Raises:
        HandtrackError: The sequence or an option is unusable.
    """
    # Imported here: `handtrack --help` need not wait for Warp.
    from handtrack.camera.source import open_sequence
    from handtrack.cli import INTERRUPTED, compute_device
    from handtrack.errors import InputError
    from handtrack.evaluation.run_record import RunRecord, write_whole
    from handtrack.hand.model import HandModel
    from handtrack.tracking.tracker import HandTracker

    if options.out.exists() and not options.out.is_dir():
        raise InputError(f"{options.out} is a file: expected a folder for the results")
    with open_sequence(options.source, format=options.format) as sequence:
        model = HandModel.load()
        side = options.side or (sequence.subject.side if sequence.subject else None) or "right"
        start = _Start.choose(options, sequence)
        shape, origin = choose_shape(options.shape, sequence, start.labelled, model, side)
        device = compute_device(options.device)
        tracker = HandTracker(
            sequence.camera, side=side, shape=None if origin == MEAN_HAND else shape,
            device=device.alias, model=model, tracker=options.tracker, seed=options.seed,
        )  # fmt: skip
        start.pose = start.resolve(tracker, model)
        options.out.mkdir(parents=True, exist_ok=True)
        record = RunRecord(camera=sequence.camera, shape=shape, side=side)
        video, interrupted = _follow(options, sequence, tracker, start, record)
        if tracker.size != 1.0:
            shape = replace(shape, scale=shape.scale * tracker.size)
            record.shape, origin = shape, f"{origin}, found {tracker.size:.3f} times as large"
    if not record:
        raise InputError(f"{options.source} has no frame")
    record.save(options.out, source=str(options.source))
    facts = _resolved(options, sequence, tracker, start, shape, origin, str(device.alias))
    content = json.dumps({**facts, "frames": len(record)}, indent=2) + "\n"
    write_whole(options.out / "config.json", content.encode("utf-8"))
    _print_table(options, record, side, origin, start.origin, device.name, video)
    return INTERRUPTED if interrupted else 0


@dataclass(slots=True, kw_only=True)
class _Start:
    """The first pose, and the frame from which it holds."""

    origin: str
    index: int = 0
    pose: Pose | None = None
    labelled: DepthFrame | None = None
    """A labelled frame; it may also tell the hand's size."""
    given: bool = False
    """Whether the labels are to give the pose."""

    @classmethod
    def choose(cls, options: TrackOptions, sequence: Sequence) -> _Start:
        """Find the first pose or say what is missing."""
        from handtrack.cli.first_pose import first_labelled, read_pose
        from handtrack.errors import InputError
        from handtrack.tracking.tracker import AUTOMATIC

        automatic = options.tracker in AUTOMATIC
        if options.start == "auto" and automatic:
            return cls(origin="found by the tracker", labelled=first_labelled(sequence))
        if options.start not in ("auto", "truth"):
            path = Path(options.start)
            return cls(origin=str(path), pose=read_pose(path))
        labelled = first_labelled(sequence)
        if labelled is None:
            raise InputError(
                f"{options.source} has no labels that tell the first pose: give it with --start "
                "POSE.json (28 numbers) or --start results.npz, or take --tracker hybrid, which "
                "finds the hand by itself"
            )
        origin = f"labels of frame {labelled.index}"
        return cls(origin=origin, index=labelled.index, labelled=labelled, given=True)

    def resolve(self, tracker: HandTracker, model: HandModel) -> Pose | None:
        """The pose for the hand that is tracked; None when the tracker finds it."""
        from handtrack.cli.first_pose import labelled_pose

        if self.pose is not None or not self.given:
            return self.pose
        assert self.labelled is not None and self.labelled.truth is not None
        return labelled_pose(self.labelled.truth, tracker.hand, model)


def choose_shape(
    wanted: str | None,
    sequence: Sequence,
    labelled: DepthFrame | None,
    model: HandModel,
    side: str,
) -> tuple[HandShape, str]:
    """Shape of the hand, and where it comes from in words.

    Args:
        wanted: "mean", a file, or None for what the sequence tells.
        sequence: The sequence.
        labelled: Its first labelled frame.
        model: The hand model.
        side: "right" or "left".
    """
    import numpy as np

    from handtrack.cli.first_pose import labelled_scale
    from handtrack.hand.shape import HandShape

    if wanted == "mean":
        return HandShape(), MEAN_HAND
    if wanted is not None:
        return HandShape.load(wanted), wanted
    subject = sequence.subject
    if subject is not None and (subject.alpha is not None or subject.scale is not None):
        nothing = np.zeros(0)
        shape = HandShape(
            alpha=nothing if subject.alpha is None else subject.alpha,
            beta=nothing if subject.beta is None else subject.beta,
            scale=1.0 if subject.scale is None else subject.scale,
        )
        return shape, "from the sequence"
    if labelled is not None and labelled.truth is not None:
        scale = labelled_scale(labelled.truth, model, side)
        if scale != 1.0:
            return HandShape(scale=scale), f"mean hand, {scale:.3f} times as large (labels)"
    return HandShape(), MEAN_HAND


def _follow(
    options: TrackOptions,
    sequence: Sequence,
    tracker: HandTracker,
    start: _Start,
    record: RunRecord,
) -> tuple[Path | None, bool]:
    """Track every frame; the video's file, and whether it was interrupted."""
    with ExitStack() as stack:
        show = None
        if options.video:
            from handtrack.viewer.pictures import OverlayPainter, PictureStyle
            from handtrack.viewer.video import VideoWriter

            style = PictureStyle(panel=_panel(sequence.camera.shape), zoom=options.zoom)
            painter = OverlayPainter(tracker.hand, sequence.camera, style=style)
            show = stack.enter_context(VideoWriter(
                options.out / "overlay.mp4", frames_per_second=sequence.frames_per_second or 30.0
            ))  # fmt: skip
        interrupted = False
        try:
            for frame in _frames(sequence):
                if start.pose is not None and frame.index == start.index:
                    tracker.reset(start.pose)
                result = tracker.track(frame.depth)
                record.add(frame, result)
                if show is not None:
                    show.write(painter.paint_result(frame.depth, result, index=frame.index))
        except KeyboardInterrupt:
            interrupted = True
    return (None if show is None else show.path), interrupted


def _frames(sequence: Sequence) -> Iterator[DepthFrame]:
    """The frames, with a progress bar."""
    from handtrack.camera.sequence import RecordedSequence
    from handtrack.cli.progress import progress

    total = len(sequence) if isinstance(sequence, RecordedSequence) else None
    return progress(sequence, total, "tracking")


def _panel(shape: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a video panel for an image's shape (height, width), both even."""
    height, width = shape
    scale = 480 / height
    return min(max(2 * round(width * scale / 2), 240), 1280), 480


def _resolved(
    options: TrackOptions,
    sequence: Sequence,
    tracker: HandTracker,
    start: _Start,
    shape: HandShape,
    shape_origin: str,
    device: str,
) -> dict[str, Any]:
    """Everything that decided the results, ready for JSON."""
    from handtrack.artifacts import artifact_files, artifact_root
    from handtrack.evaluation.report import versions
    from handtrack.tracking.tracker import TRACKERS

    root = artifact_root()
    pose = None if start.pose is None else start.pose.tolist()
    return {
        "command": "track",
        "source": str(options.source),
        "format": getattr(sequence, "format", None),
        "camera": sequence.camera.to_dict(),
        "side": tracker.side,
        "shape": {
            "origin": shape_origin,
            "alpha": shape.alpha.tolist(), "beta": shape.beta.tolist(), "scale": shape.scale,
        },
        "start": {"origin": start.origin, "frame": start.index, "pose": pose},
        "tracker": options.tracker,
        "tracker_config": asdict(cast(Any, TRACKERS[options.tracker])),
        "seed": options.seed,
        "device": device,
        "versions": versions(),
        "artifacts": {
            path.relative_to(root).as_posix(): _sha256(path)
            for path in artifact_files() if path.is_relative_to(root / "models")
        },
    }  # fmt: skip


def _sha256(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _print_table(
    options: TrackOptions,
    record: RunRecord,
    side: str,
    shape: str,
    start: str,
    device: str,
    video: Path | None,
) -> None:
    """What came out, in a short table, and where it was written."""
    import numpy as np
    from rich.console import Console

    from handtrack.evaluation.report import terminal_table
    from handtrack.tracking.result import TrackState

    states = record.states
    rows = [["frames", str(len(record)), ""]]
    timed = len(record.timer)
    if timed:
        speed = record.timer.summary(skip=min(WARM_UP, timed - 1))
        rows += [
            ["frames per second, median", f"{speed.frames_per_second:.0f}", "1/s"],
            ["time per frame, median", f"{speed.latency_ms['p50']:.2f}", "ms"],
            ["time per frame, 95th percentile", f"{speed.latency_ms['p95']:.2f}", "ms"],
        ]
    errors = record.depth_errors
    if np.isfinite(errors).any():
        rows.append(["depth error, median", f"{1e3 * np.nanmedian(errors):.2f}", "mm"])
    rows += [
        [f"state {state.value.replace('_', ' ')}", str(states[state]), "frames"]
        for state in TrackState if states[state] or state is TrackState.TRACKING
    ]  # fmt: skip
    damaged = sum(map(bool, record.problems))
    accuracy = record.accuracy()
    if accuracy is not None:
        rows += [
            ["keypoint error, mean", f"{accuracy.mean_mm:.2f}", "mm"],
            ["keypoint error, median", f"{accuracy.median_mm:.2f}", "mm"],
            ["keypoint error, 95th percentile", f"{accuracy.p95_mm:.2f}", "mm"],
        ]
    console = Console(soft_wrap=True, highlight=False)
    console.print(terminal_table("", ["metric", "value", "unit"], rows))
    console.print(
        f"{options.tracker} tracker on {device}; {side} hand, shape: {shape}; first pose: {start}"
    )
    if damaged:
        first = next(place for place, problem in enumerate(record.problems) if problem)
        console.print(
            f"{damaged} of {len(record)} frames could not be used or explained, the first: "
            f"frame {record.frames[first]}, {record.problems[first]}"
        )
    names = ["results.npz", "results.csv", "config.json", *([video.name] if video else [])]
    console.print(f"written to {options.out}: {', '.join(names)}")
