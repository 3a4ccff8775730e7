"""Run a tracker over frames with truth: accuracy and speed of the same run, as a benchmark case."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.evaluation.metrics import keypoint_errors, summarize
from handtrack.evaluation.timing import StageTimer
from handtrack.hand.skeleton import NKEYPOINT, NQ
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Passes items on while showing how far they are: items, their number, what is being done."""

TOTAL_STAGE = "total"
"""Entry of `HandResult.timings` that holds the whole frame."""

_WARM_UP = 2
"""Frames tracked before the clock counts: the first loads kernels, the second replays the graph."""


def no_progress(items: Iterable[Any], total: int, text: str) -> Iterator[Any]:
    """Pass the items on in silence."""
    del total, text
    yield from items


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a tracker found in each frame of a run, beside the truth."""

    frames: NDArray[np.int64]
    """Number of each frame in its sequence, shape (n,)."""
    poses: Float
    """Poses found, shape (n, 28), NaN for none."""
    keypoints: Float
    """Keypoints found [m], shape (n, 21, 3), NaN for none."""
    truth: Float
    """True keypoints [m], shape (n, 21, 3), NaN where they are not known."""
    depth_errors: Float
    """E_d of Eq. II.19 [m], shape (n,), NaN for none."""
    states: tuple[TrackState, ...]
    """What the tracker said of itself."""
    latencies_ms: Float
    """Time from depth image to result [ms], shape (n,)."""
    stages_ms: tuple[Mapping[str, float], ...]
    """Time spent per stage [ms] in each frame."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def labelled(self) -> NDArray[np.bool_]:
        """Frames whose true keypoints are known, shape (n,)."""
        return np.asarray(np.isfinite(self.truth).all(axis=(1, 2)))

    @property
    def errors_mm(self) -> Float:
        """Error of every keypoint in the labelled frames [mm], shape (nlabelled, 21)."""
        known = self.labelled
        return keypoint_errors(self.keypoints[known], self.truth[known])

    @property
    def frame_errors_mm(self) -> Float:
        """Mean keypoint error of each frame [mm], shape (n,), NaN where there is no truth."""
        means = np.full(len(self), np.nan)
        known = self.labelled
        if known.any():
            means[known] = self.errors_mm.mean(axis=1)
        return means


def run_tracker(
    tracker: HandTracker,
    frames: Sequence[DepthFrame],
    starts: Mapping[int, Float],
    *,
    progress: Progress = no_progress,
    text: str = "tracking",
) -> Run:
    """Track frames one after the other.

    A frame whose pose is given is tracked, and counted, like every other.

    Args:
        tracker: The tracker; its past is forgotten.
        frames: Depth frames, with whatever truth they carry.
        starts: Place among `frames` -> pose given there, shape (28,): the first frame of each take.
        progress: Shows how far the run is.
        text: What the progress says.

    Raises:
        InputError: There are no frames, or a start lies beyond them.
    """
    if not frames:
        raise InputError("there are no frames to track")
    if any(not 0 <= place < len(frames) for place in starts):
        raise InputError(f"start poses are given at {sorted(starts)} of {len(frames)} frames")
    first = min(starts, default=0)
    for _ in range(_WARM_UP):
        tracker.reset(starts.get(first))
        tracker.track(frames[first].depth)
    tracker.reset()

    poses = np.full((len(frames), NQ), np.nan)
    points = np.full((len(frames), NKEYPOINT, 3), np.nan)
    depth_errors = np.full(len(frames), np.nan)
    latencies = np.zeros(len(frames))
    numbers, states, stages = [], [], []
    truth = np.full_like(points, np.nan)
    for place, frame in enumerate(progress(frames, len(frames), text)):
        if place in starts:
            tracker.reset(starts[place])
        begin = perf_counter()
        result = tracker.track(frame.depth)
        latencies[place] = 1e3 * (perf_counter() - begin)
        poses[place], depth_errors[place] = result.pose, result.depth_error
        points[place] = result.keypoints
        truth[place] = true_keypoints(frame)
        numbers.append(frame.index)
        states.append(result.state)
        stages.append({k: ms for k, ms in result.timings.items() if k != TOTAL_STAGE})
    return Run(
        frames=np.array(numbers),
        poses=poses,
        keypoints=points,
        truth=truth,
        depth_errors=depth_errors,
        states=tuple(states),
        latencies_ms=latencies,
        stages_ms=tuple(stages),
    )


def true_keypoints(frame: DepthFrame) -> Float:
    """True keypoints of a frame [m], shape (21, 3), NaN where they are not known."""
    if frame.truth is None or frame.truth.keypoints is None:
        return np.full((NKEYPOINT, 3), np.nan)
    return np.asarray(frame.truth.keypoints, np.float64)


def join_runs(runs: Sequence[Run]) -> Run:
    """Several runs as one, for numbers over all of them."""
    if not runs:
        raise InputError("there are no runs to join")
    arrays = ("frames", "poses", "keypoints", "truth", "depth_errors", "latencies_ms")
    return Run(
        **{name: np.concatenate([getattr(run, name) for run in runs]) for name in arrays},
        states=tuple(state for run in runs for state in run.states),
        stages_ms=tuple(stages for run in runs for stages in run.stages_ms),
    )


def bench_case(run: Run, *, case: str, tracker: str, **more: Any) -> dict[str, Any]:
    """A run in the layout of the benchmark file (`handtrack.evaluation.report`).

    Args:
        run: The run.
        case: Name of the case.
        tracker: Name of the tracker.
        **more: Further entries, put behind the accuracy.
    """
    timer = StageTimer()
    for stages, total in zip(run.stages_ms, run.latencies_ms, strict=True):
        timer.add_frame(stages, total_ms=float(total))
    known = run.labelled
    accuracy: dict[str, Any] = {}
    if known.any():
        accuracy = summarize(run.keypoints[known], run.truth[known]).to_dict()
        accuracy["labelled_frames"] = int(known.sum())
    scored = run.depth_errors[np.isfinite(run.depth_errors)]
    if len(scored):
        accuracy["depth_error_mm"] = {
            "mean": 1e3 * float(scored.mean()),
            "median": 1e3 * float(np.median(scored)),
        }
    counted = Counter(state.value for state in run.states)
    return {
        "case": case,
        "tracker": tracker,
        **accuracy,
        "states": {state.value: counted[state.value] for state in TrackState},
        **more,
        **timer.summary().to_dict(),
    }
