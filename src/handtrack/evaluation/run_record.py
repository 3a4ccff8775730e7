"""The record of one run of a tracker over a sequence: results.npz and results.csv."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.evaluation.metrics import AccuracySummary, summarize
from handtrack.evaluation.timing import StageTimer
from handtrack.files import whole_file
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import ANGLES, KEYPOINTS, POSE
from handtrack.tracking.result import HandResult, TrackState

FORMAT_VERSION = 1
"""Version of the layout of results.npz."""

COLUMNS: tuple[str, ...] = (
    "frame", "time_s", "state", "depth_error_m",
    "tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz", *(f"{name}_rad" for name in ANGLES),
    *(f"{name}_{axis}_m" for name in KEYPOINTS for axis in "xyz"),
    *(f"{name}_std_m" for name in KEYPOINTS),
)  # fmt: skip
"""Columns of results.csv."""


@dataclass(slots=True)
class RunRecord:
    """What a tracker said about every frame of a sequence, in order."""

    camera: Camera
    """Camera of the sequence."""
    shape: HandShape
    """Shape of the hand that was tracked."""
    side: str
    """Which hand."""
    results: list[HandResult] = field(default_factory=list)
    """Result of each frame."""
    frames: list[int] = field(default_factory=list)
    """Number of each frame in the sequence."""
    times: list[float] = field(default_factory=list)
    """Time stamp of each frame [s]."""
    problems: list[str] = field(default_factory=list)
    """What was wrong with each frame, empty text for nothing."""
    truth: list[NDArray[np.float32] | None] = field(default_factory=list)
    """True keypoints [m] of each frame, shape (21, 3), None where they are not known."""
    timer: StageTimer = field(default_factory=StageTimer)
    """Time spent on each frame that was tracked."""

    def __len__(self) -> int:
        return len(self.results)

    def add(self, frame: DepthFrame, result: HandResult) -> None:
        """Append one frame."""
        self.results.append(result)
        self.frames.append(frame.index)
        self.times.append(frame.time)
        self.problems.append(frame.problem or result.problem or "")
        self.truth.append(None if frame.truth is None else frame.truth.keypoints)
        stages = dict(result.timings)
        total = stages.pop("total", None)
        if total is not None:
            self.timer.add_frame(stages, total_ms=total)

    @property
    def keypoints(self) -> NDArray[np.float32]:
        """Keypoints [m], shape (n, 21, 3); NaN where no hand was found."""
        return np.stack([result.keypoints for result in self.results])

    @property
    def keypoint_std(self) -> NDArray[np.float32]:
        """One sigma of each keypoint [m], shape (n, 21); NaN where it is not known."""
        return np.stack([result.keypoint_std for result in self.results])

    @property
    def depth_errors(self) -> NDArray[np.float64]:
        """Depth error E_d [m], shape (n,); NaN where there is none."""
        return np.array([result.depth_error for result in self.results])

    @property
    def states(self) -> Counter[TrackState]:
        """How many frames ended in which state."""
        return Counter(result.state for result in self.results)

    def accuracy(self) -> AccuracySummary | None:
        """Accuracy over the frames whose true keypoints are known, None without any."""
        known = {
            place: points
            for place, points in enumerate(self.truth)
            if points is not None and np.isfinite(points).all()
        }
        if not known:
            return None
        return summarize(self.keypoints[list(known)], np.stack(list(known.values())))

    def save(self, folder: str | os.PathLike[str], *, source: str = "") -> list[Path]:
        """Write results.npz and results.csv, each replaced as a whole.

        Args:
            folder: Where; must exist.
            source: Where the depth came from.

        Returns:
            The files.
        """
        folder = Path(folder)
        return [
            write_whole(folder / "results.npz", self._npz(source)),
            write_whole(folder / "results.csv", self._csv()),
        ]

    def _npz(self, source: str) -> bytes:
        """Content of results.npz."""
        nothing = np.full((len(KEYPOINTS), 3), np.nan, np.float32)
        stages = list(self.results[0].timings) if self.results else []
        for result in self.results:
            stages += [name for name in result.timings if name not in stages]
        arrays = {
            "format_version": FORMAT_VERSION,
            "source": source,
            "side": self.side,
            "camera": np.array(list(self.camera.to_dict().values()), np.float64),
            "shape_alpha": self.shape.alpha,
            "shape_beta": self.shape.beta,
            "scale": self.shape.scale,
            "frame_index": np.array(self.frames, np.int64),
            "time": np.array(self.times, np.float64),
            "state": np.array([result.state.value for result in self.results]),
            "problem": np.array(self.problems),
            "depth_error": self.depth_errors,
            "pose": np.stack([result.pose for result in self.results]),
            "pose_names": np.array(POSE),
            "keypoints": self.keypoints,
            "keypoint_std": self.keypoint_std,
            "keypoint_names": np.array(KEYPOINTS),
            "timing_names": np.array(stages, dtype=str),
            "timings_ms": np.array(
                [[result.timings.get(name, np.nan) for name in stages] for result in self.results]
            ),
        }
        if any(points is not None for points in self.truth):
            arrays["truth_keypoints"] = np.stack(
                [nothing if points is None else points for points in self.truth]
            )
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()

    def _csv(self) -> bytes:
        """Content of results.csv."""
        return csv_table(
            self.frames,
            self.times,
            [result.state for result in self.results],
            self.depth_errors,
            np.stack([result.pose for result in self.results]),
            self.keypoints,
            self.keypoint_std,
        )


def csv_table(
    frames: Iterable[int],
    times: Iterable[float],
    states: Sequence[TrackState],
    depth_errors: NDArray[np.floating],
    poses: NDArray[np.floating],
    keypoints: NDArray[np.floating],
    keypoint_std: NDArray[np.floating],
) -> bytes:
    """Table with `COLUMNS` and a row per frame; what is not known is an empty cell.

    Args:
        frames: Number of each frame.
        times: Its time stamp [s].
        states: Its state, n of them.
        depth_errors: Depth errors E_d [m], shape (n,).
        poses: Poses, shape (n, 28).
        keypoints: Keypoints [m], shape (n, 21, 3).
        keypoint_std: One sigma of each [m], shape (n, 21).
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    numbers = np.concatenate(
        [depth_errors[:, None], poses, keypoints.reshape(len(states), -1), keypoint_std], axis=1
    )
    for frame, time, state, row in zip(frames, times, states, numbers, strict=True):
        cells = [f"{number:.7g}" if np.isfinite(number) else "" for number in row]
        writer.writerow([frame, f"{time:.6f}", state.value, *cells])
    return text.getvalue().encode("utf-8")


def write_whole(path: Path, content: bytes) -> Path:
    """Write a file so that it is there complete or not at all; returns its path."""
    with whole_file(path) as file:
        file.write(content)
    return path
