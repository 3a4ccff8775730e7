"""Tracking one sequence for `handtrack track`: its results, its recording, its video, its table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from handtrack.cli.track import TrackOptions, choose_shape, choose_side

if TYPE_CHECKING:
    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.recorder import Recorder
    from handtrack.camera.sequence import Sequence
    from handtrack.cli.first_pose import Pose
    from handtrack.evaluation.run_record import RunRecord
    from handtrack.hand.model import HandModel
    from handtrack.tracking.result import HandResult
    from handtrack.tracking.tracker import HandTracker

WARM_UP = 2
"""Frames at the start that speed is not measured on: they load and capture the kernels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedSequence:
    """What tracking one sequence gave."""

    record: RunRecord
    """Result of every frame."""
    interrupted: bool
    """Whether Ctrl-C ended it early."""
    live: bool
    """Whether frames came from a device."""
    dropped: int
    """Frames of a live source that were never tracked."""
    shape: str
    """Where the hand's shape came from, in words."""
    start: str
    """Where the first pose came from, in words."""
    device: str
    """Name of the compute device."""
    video: Path | None
    """The video, None without one."""
    recorder: Recorder | None
    """What was recorded, None without `--record`."""


def track_sequence(
    options: TrackOptions, source: str, out: Path, *, bar: bool = True
) -> TrackedSequence:
    """Track one sequence and write its results; config.json comes last, so it says "done".

    Args:
        options: The command's options.
        source: What to track.
        out: Folder for the results; made when it does not exist.
        bar: Show how far it is.

    Raises:
        HandtrackError: The sequence or an option is unusable.
    """
    # Imported here: `handtrack track --help` need not wait for Warp.
    from handtrack.camera.source import open_sequence
    from handtrack.cli import compute_device
    from handtrack.errors import InputError
    from handtrack.evaluation.run_record import RunRecord, write_whole
    from handtrack.hand.model import HandModel
    from handtrack.tracking.tracker import HandTracker

    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: expected a folder for the results")
    with open_sequence(source, format=options.format, topic=options.topic) as sequence:
        model = HandModel.load()
        side = choose_side(options.side, sequence)
        start = _Start.choose(options, sequence)
        shape, origin = choose_shape(options.shape, sequence, start.labelled, model, side)
        device = compute_device(options.device)
        tracker = HandTracker(
            sequence.camera, side=side, shape=shape, device=device.alias, model=model,
            tracker=options.tracker, seed=options.seed, adapt_shape=options.adapt_shape,
        )  # fmt: skip
        start.pose = start.resolve(tracker, model)
        out.mkdir(parents=True, exist_ok=True)
        record = RunRecord(camera=sequence.camera, shape=tracker.shape, side=side)
        follow = _Follow(options, sequence, tracker, start, record, out, bar)
        follow.run()
        dropped = sequence.dropped
        record.shape = tracker.shape  # as it was given, or found since
        if options.adapt_shape:
            sure = "sure" if tracker.shape_frozen else "not sure yet"
            origin = f"{origin}, then adapted ({sure})"
        elif tracker.size != 1.0:
            origin = f"{origin}, found {tracker.size:.3f} times as large"
    if not record:
        raise InputError(f"{source} has no frame")
    record.save(out, source=source)
    facts = _resolved(options, source, sequence, tracker, start, origin, str(device.alias))
    facts |= {
        "frames": len(record), "complete": not follow.interrupted or sequence.live,
        "request": request(options, source),
    }  # fmt: skip
    write_whole(out / "config.json", (json.dumps(facts, indent=2) + "\n").encode("utf-8"))
    return TrackedSequence(
        record=record, interrupted=follow.interrupted, live=sequence.live, dropped=dropped,
        shape=origin, start=start.origin, device=device.name, video=follow.video,
        recorder=follow.recorder,
    )  # fmt: skip


_RESULT_OPTIONS = (
    "tracker", "shape", "adapt_shape", "side", "start", "format", "topic", "frames", "seed",
    "video", "zoom",
)  # fmt: skip
"""Options that make a difference to what is written."""


def request(options: TrackOptions, source: str) -> dict[str, Any]:
    """What results were asked for, ready for JSON: equal requests give equal results."""
    from handtrack import __version__

    asked = {name: getattr(options, name) for name in _RESULT_OPTIONS}
    return {"handtrack": __version__, "source": source, **asked}


def is_done(options: TrackOptions, source: str, out: Path) -> bool:
    """Whether complete results of the same request lie in a folder."""
    from handtrack.camera.readers.png_folder import read_json
    from handtrack.errors import HandtrackError

    try:
        facts = read_json(out / "config.json")
    except HandtrackError:
        return False
    written = all((out / name).is_file() for name in ("results.npz", "results.csv"))
    same = facts.get("request") == request(options, source)
    return written and same and facts.get("complete") is True


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
                f"{sequence.name} has no labels that tell the first pose: give it with --start "
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


class _Follow:
    """Tracks the frames of a sequence, records and draws them."""

    def __init__(
        self,
        options: TrackOptions,
        sequence: Sequence,
        tracker: HandTracker,
        start: _Start,
        record: RunRecord,
        out: Path,
        bar: bool,
    ) -> None:
        self._options, self._sequence, self._tracker = options, sequence, tracker
        self._start, self._record, self._out, self._bar = start, record, out, bar
        self.interrupted = False
        self.video: Path | None = None
        self.recorder: Recorder | None = None

    def run(self) -> None:
        """Track every frame, until the end or Ctrl-C."""
        with ExitStack() as stack:
            show = self._shown(stack)
            if self._options.record is not None:
                from handtrack.camera.recorder import Recorder

                self.recorder = stack.enter_context(Recorder(
                    self._options.record, self._sequence.camera, side=self._tracker.side,
                    frames_per_second=self._sequence.frames_per_second,
                    lossless=not self._sequence.live,
                ))  # fmt: skip
            try:
                for frame in self._frames():
                    if self._start.pose is not None and frame.index == self._start.index:
                        self._tracker.reset(self._start.pose)
                    if self.recorder is not None:
                        self.recorder.frame(frame)
                    result = self._tracker.track(frame.depth)
                    self._record.add(frame, result)
                    show(frame, result)
            except KeyboardInterrupt:
                self.interrupted = True

    def _shown(self, stack: ExitStack) -> Callable[[DepthFrame, HandResult], None]:
        """What draws a frame into the video, or does nothing."""
        if not self._options.video:
            return lambda frame, result: None
        from handtrack.viewer.pictures import OverlayPainter, PictureStyle
        from handtrack.viewer.video import VideoWriter

        camera = self._sequence.camera
        style = PictureStyle(panel=_panel(camera.shape), zoom=self._options.zoom)
        painter = OverlayPainter(self._tracker.hand, camera, style=style)
        writer = stack.enter_context(VideoWriter(
            self._out / "overlay.mp4",
            frames_per_second=self._sequence.frames_per_second or 30.0,
        ))  # fmt: skip
        self.video = writer.path
        return lambda frame, result: writer.write(
            painter.paint_result(frame.depth, result, index=frame.index)
        )

    def _frames(self) -> Iterator[DepthFrame]:
        """The frames that are asked for, with a progress bar."""
        from handtrack.camera.sequence import RecordedSequence
        from handtrack.cli.progress import progress

        total = len(self._sequence) if isinstance(self._sequence, RecordedSequence) else None
        limit = self._options.frames
        if limit is not None:
            total = limit if total is None else min(limit, total)
        frames = islice(self._sequence, limit)
        return progress(frames, total, "tracking") if self._bar else frames


def _panel(shape: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a video panel for an image's shape (height, width), both even."""
    height, width = shape
    scale = 480 / height
    return min(max(2 * round(width * scale / 2), 240), 1280), 480


def _resolved(
    options: TrackOptions,
    source: str,
    sequence: Sequence,
    tracker: HandTracker,
    start: _Start,
    shape_origin: str,
    device: str,
) -> dict[str, Any]:
    """Everything that decided the results, ready for JSON."""
    from handtrack.artifacts import artifact_files, artifact_root
    from handtrack.evaluation.report import versions
    from handtrack.tracking.tracker import TRACKERS

    root = artifact_root()
    pose = None if start.pose is None else start.pose.tolist()
    shape = tracker.shape
    return {
        "command": "track",
        "source": source,
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


def print_table(options: TrackOptions, out: Path, tracked: TrackedSequence) -> None:
    """What came out, in a short table, and where it was written."""
    import numpy as np
    from rich.console import Console

    from handtrack.evaluation.report import terminal_table
    from handtrack.tracking.result import TrackState

    record = tracked.record
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
    if tracked.live:
        rows.append(["frames dropped", str(tracked.dropped), ""])
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
        f"{options.tracker} tracker on {tracked.device}; {record.side} hand, shape: "
        f"{tracked.shape}; first pose: {tracked.start}"
    )
    if damaged:
        first = next(place for place, problem in enumerate(record.problems) if problem)
        console.print(
            f"{damaged} of {len(record)} frames could not be used or explained, the first: "
            f"frame {record.frames[first]}, {record.problems[first]}"
        )
    if tracked.recorder is not None:
        left_out = f", {tracked.recorder.dropped} left out" if tracked.recorder.dropped else ""
        console.print(
            f"recorded to {tracked.recorder.folder}: {tracked.recorder.written} frames{left_out}"
        )
    names = ["results.npz", "results.csv", "config.json"]
    names += [tracked.video.name] if tracked.video else []
    console.print(f"written to {out}: {', '.join(names)}")
