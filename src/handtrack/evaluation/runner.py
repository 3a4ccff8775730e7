"""Run a tracker over frames with truth: accuracy and speed of the same run, as a benchmark case."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.evaluation.metrics import calibration, keypoint_errors, summarize
from handtrack.evaluation.timing import StageTimer
from handtrack.hand.skeleton import NKEYPOINT
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Passes items on while showing how far they are: items, their number, what is being done."""

TOTAL_STAGE = "total"
"""Entry of `HandResult.timings` that holds the whole frame."""

_WARM_UP = 2
"""Frames tracked before the clock counts: the first loads kernels, the second replays the graph."""

_NO_DEPTH = np.zeros((0, 0), np.float32)
"""In place of an image that was tracked: a run keeps no images."""


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
    deviations: Float
    """One sigma of each keypoint as the tracker states it [m], shape (n, 21), NaN for none."""
    visible: Float
    """1 for true keypoints in sight, 0 for hidden ones, shape (n, 21), NaN where that is not
    known."""
    depth_errors: Float
    """E_d of Eq. II.19 [m], shape (n,), NaN for none."""
    states: tuple[TrackState, ...]
    """What the tracker said of itself."""
    latencies_ms: Float
    """Time from depth image to result [ms], shape (n,)."""
    stages_ms: tuple[Mapping[str, float], ...]
    """Time spent per stage [ms] in each frame."""
    poses_given: int = 0
    """How often the tracker was told a pose."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Frames whose pose the tracker vouches for (TRACKING or RECOVERED), shape (n,)."""
        return np.array([state.sure for state in self.states], bool)

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
    def calibration(self) -> dict[str, dict[str, float]]:
        """How often errors are within the stated deviations: `metrics.calibration`.

        Over the labelled frames; empty when no deviation is stated in any.
        """
        known = self.labelled & np.isfinite(self.deviations).any(axis=1)
        if not known.any():
            return {}
        errors = keypoint_errors(self.keypoints[known], self.truth[known])
        return calibration(errors, 1e3 * self.deviations[known], self.visible[known])

    @property
    def frame_errors_mm(self) -> Float:
        """Mean keypoint error of each frame [mm], shape (n,), NaN where there is no truth."""
        means = np.full(len(self), np.nan)
        known = self.labelled
        if known.any():
            means[known] = self.errors_mm.mean(axis=1)
        return means


class RunLog:
    """Collects what a tracker finds, frame after frame."""

    def __init__(self) -> None:
        """Start without any frame."""
        self._frames: list[DepthFrame] = []
        self._results: list[HandResult] = []
        self._latencies: list[float] = []
        self._visible: list[Float] = []

    def track(
        self, tracker: HandTracker, frame: DepthFrame, visible: ArrayLike | None = None
    ) -> HandResult:
        """Let a tracker find the hand in the next frame, on the clock.

        Args:
            tracker: The tracker, which goes on from its past.
            frame: The frame, with whatever truth it carries.
            visible: Whether each true keypoint is in sight, shape (21,); None when not known.
        """
        begin = perf_counter()
        result = tracker.track(frame.depth)
        self._latencies.append(1e3 * (perf_counter() - begin))
        self._frames.append(replace(frame, depth=_NO_DEPTH))
        self._results.append(result)
        seen = np.full(NKEYPOINT, np.nan) if visible is None else np.asarray(visible, np.float64)
        self._visible.append(seen)
        return result

    def run(self, *, poses_given: int = 0) -> Run:
        """All frames so far.

        Args:
            poses_given: How often the tracker was told a pose.

        Raises:
            InputError: There are none.
        """
        if not self._frames:
            raise InputError("there are no frames to track")
        results = self._results
        return Run(
            frames=np.array([frame.index for frame in self._frames]),
            poses=np.stack([result.pose for result in results]).astype(np.float64),
            keypoints=np.stack([result.keypoints for result in results]).astype(np.float64),
            truth=np.stack([true_keypoints(frame) for frame in self._frames]),
            deviations=np.stack([result.keypoint_std for result in results]).astype(np.float64),
            visible=np.stack(self._visible),
            depth_errors=np.array([result.depth_error for result in results], np.float64),
            states=tuple(result.state for result in results),
            latencies_ms=np.array(self._latencies),
            stages_ms=tuple(
                {stage: ms for stage, ms in result.timings.items() if stage != TOTAL_STAGE}
                for result in results
            ),
            poses_given=poses_given,
        )


def run_tracker(
    tracker: HandTracker,
    frames: Sequence[DepthFrame],
    starts: Mapping[int, Float],
    *,
    visible: ArrayLike | None = None,
    memory: bool = True,
    progress: Progress = no_progress,
    text: str = "tracking",
) -> Run:
    """Track frames one after the other.

    A frame whose pose is given is tracked, and counted, like every other. A tracker that finds the
    hand by itself is given no pose: to it a cut between takes is a jump like any other.

    Args:
        tracker: The tracker; its past is forgotten.
        frames: Depth frames, with whatever truth they carry.
        starts: Place among `frames` -> pose given there, shape (28,): the first frame of each take.
        visible: Whether each true keypoint is in sight, shape (n, 21); None when it is not known.
        memory: False forgets everything before each frame.
        progress: Shows how far the run is.
        text: What the progress says.

    Raises:
        InputError: There are no frames, or a start lies beyond them.
    """
    if not frames:
        raise InputError("there are no frames to track")
    if any(not 0 <= place < len(frames) for place in starts):
        raise InputError(f"start poses are given at {sorted(starts)} of {len(frames)} frames")
    seen = None if visible is None else np.asarray(visible, np.float64)
    if seen is not None and seen.shape != (len(frames), NKEYPOINT):
        raise InputError(f"visible has shape {seen.shape}: expected ({len(frames)}, {NKEYPOINT})")
    given = {} if tracker.automatic else starts
    first = min(given, default=0)
    warm_up(tracker, frames[first], given.get(first))

    log = RunLog()
    for place, frame in enumerate(progress(frames, len(frames), text)):
        if place in given or not memory:
            tracker.reset(given.get(place))
        log.track(tracker, frame, None if seen is None else seen[place])
    return log.run(poses_given=len(given))


def warm_up(tracker: HandTracker, frame: DepthFrame, pose: Float | None) -> None:
    """Track a frame off the clock, from a pose, shape (28,), or from nothing, and forget it."""
    for _ in range(_WARM_UP):
        tracker.reset(pose)
        tracker.track(frame.depth)
    tracker.reset()


def true_keypoints(frame: DepthFrame) -> Float:
    """True keypoints of a frame [m], shape (21, 3), NaN where they are not known."""
    if frame.truth is None or frame.truth.keypoints is None:
        return np.full((NKEYPOINT, 3), np.nan)
    return np.asarray(frame.truth.keypoints, np.float64)


def join_runs(runs: Sequence[Run]) -> Run:
    """Several runs as one, for numbers over all of them."""
    if not runs:
        raise InputError("there are no runs to join")
    arrays = (
        "frames", "poses", "keypoints", "truth", "deviations", "visible", "depth_errors",
        "latencies_ms",
    )  # fmt: skip
    return Run(
        **{name: np.concatenate([getattr(run, name) for run in runs]) for name in arrays},
        states=tuple(state for run in runs for state in run.states),
        stages_ms=tuple(stages for run in runs for stages in run.stages_ms),
        poses_given=sum(run.poses_given for run in runs),
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
        if calibrated := run.calibration:
            accuracy["calibration"] = calibrated
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
        "poses_given": run.poses_given,
        **more,
        **timer.summary().to_dict(),
    }
