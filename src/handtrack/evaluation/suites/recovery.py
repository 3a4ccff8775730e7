"""Suite `recovery`: the tracked pose is scrambled; how many frames until tracking is back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.evaluation.metrics import keypoint_errors, summarize_errors
from handtrack.evaluation.runner import RunLog, bench_case, true_keypoints, warm_up
from handtrack.evaluation.suites.subjects import SubjectFrames, render_subject, subject_tracker
from handtrack.evaluation.suites.suite import (
    Curves,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.synthesis.viewpoints import random_rotation
from handtrack.tracking.tracker import HandTracker
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

_WITHIN = (1, 2, 3, 5, 10)
"""Numbers of frames for which the share of trials that are back is told."""


@dataclass(slots=True)
class _Trials:
    """What one tracker did after every scrambling."""

    log: RunLog = field(default_factory=RunLog)
    needed: list[int | None] = field(default_factory=list)
    """Frames until the trial was back; None when it was not."""
    errors_mm: list[Float] = field(default_factory=list)
    """Error of every keypoint in the last frame of the trial [mm], shape (21,)."""


def recovery_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/recovery.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    seeds = data["subjects"]
    trials = {name: _Trials() for name in data["trackers"]}
    for number, seed in enumerate(seeds):
        subject = render_subject(data, seed, settings, model)
        # As many trials for each subject as possible, the first ones get what is left over.
        count = len(range(number, int(data["trials"]), len(seeds)))
        places = drawn_places(subject, count, data, np.random.default_rng([data["seed"], seed]))
        for name, found in trials.items():
            tracker = subject_tracker(subject, settings, model, tracker=name)
            warm_up(tracker, subject.frames[0], _true_pose(subject.frames[0]))
            shown = settings.progress(places, len(places), f"subject {seed}, {name}")
            for trial, place in enumerate(shown):
                # The same poses for every tracker.
                rng = np.random.default_rng([data["seed"], seed, trial])
                frames = subject.frames[place : place + int(data["most_frames"])]
                pose = scrambled(_true_pose(frames[0]), tracker.hand, rng, data["reach"])
                _try(tracker, pose, frames, data["recovered_mm"], found)
        del subject
    found_cases = [_case(name, found, data, settings) for name, found in trials.items()]
    return SuiteResult(
        suite="recovery",
        cases=found_cases,
        targets=judged(found_cases, data["targets"], data["trackers"][0]),
        curves=[_curves(trials, int(data["most_frames"]))],
        notes=[
            f"shape {settings.shape}; a trial ends when the mean error is below "
            f"{data['recovered_mm']:g} mm, or after {data['most_frames']} frames; errors are "
            "those of each trial's last frame, times those of all its frames"
        ],
    )


def drawn_places(
    subject: SubjectFrames, count: int, data: Mapping[str, Any], rng: np.random.Generator
) -> list[int]:
    """Frames at which the state is scrambled, ascending.

    Args:
        subject: The frames and their takes.
        count: How many.
        data: The suite's `most_frames`: so many are left before the take ends.
        rng: Source of the random numbers.

    Raises:
        InputError: There are not so many frames.
    """
    ends = [*subject.segment_starts[1:].tolist(), len(subject.frames)]
    allowed = [
        place
        for first, end in zip(subject.segment_starts.tolist(), ends, strict=True)
        for place in range(first, end - int(data["most_frames"]) + 1)
    ]
    if count > len(allowed):
        raise InputError(
            f"{count} trials of {data['most_frames']} frames are more than the motion has room "
            f"for: {len(allowed)}"
        )
    return np.sort(rng.choice(allowed, count, replace=False)).tolist()


def scrambled(pose: Float, hand: ShapedHand, rng: np.random.Generator, reach: float) -> Float:
    """A pose of random direction and random joint angles, its palm moved.

    Args:
        pose: The pose, shape (28,).
        hand: The hand that has it; gives the joint limits.
        rng: Source of the random numbers.
        reach: Largest distance of the palm's middle from where it was [m]; all distances up to it
            are as likely.

    Returns:
        Shape (28,).
    """
    low, high = hand.limits.T
    away = rng.standard_normal(3)
    away *= reach * rng.random() / np.linalg.norm(away)
    middle = palm_centre(keypoints(hand, pose)) + away
    found = np.zeros_like(pose)
    found[3:7] = matrix_to_quat(random_rotation(rng))
    found[7:] = rng.uniform(low, high)
    found[:3] = middle - palm_centre(keypoints(hand, found))
    return found


def _try(
    tracker: HandTracker,
    pose: Float,
    frames: Sequence[DepthFrame],
    recovered_mm: float,
    trials: _Trials,
) -> None:
    """Track on from a scrambled pose until the hand is found again, or to the last frame."""
    tracker.reset(pose)
    errors, needed = np.zeros((1, 0)), None
    for number, frame in enumerate(frames, start=1):
        result = trials.log.track(tracker, frame)
        errors = keypoint_errors(result.keypoints[None], true_keypoints(frame)[None])
        if errors.mean() < recovered_mm:
            needed = number
            break
    trials.needed.append(needed)
    trials.errors_mm.append(errors[0])


def _case(
    name: str, trials: _Trials, data: Mapping[str, Any], settings: SuiteSettings
) -> dict[str, Any]:
    """The case of one tracker."""
    count = len(trials.needed)
    back = [frames for frames in trials.needed if frames is not None]
    accuracy = summarize_errors(np.stack(trials.errors_mm)).to_dict()
    more: dict[str, Any] = {
        key: accuracy[key] for key in ("keypoint_error_mm", "success_rate", "lost_rate")
    }
    more |= {
        "shape": settings.shape,
        "subjects": list(data["subjects"]),
        "trials": count,
        **{f"within_{n}": sum(frames <= n for frames in back) / count for n in _WITHIN},
        "recovered": len(back) / count,
        "frames_needed": {
            str(n): back.count(n) for n in range(1, int(data["most_frames"]) + 1) if n in back
        },
    }
    run = trials.log.run(poses_given=count)
    return bench_case(run, case="all", tracker=name, **more)


def _curves(trials: Mapping[str, _Trials], most_frames: int) -> Curves:
    """Share of trials that are back within a number of frames."""
    frames = np.arange(0, most_frames + 1, dtype=np.float64)
    lines = {}
    for name, found in trials.items():
        needed = np.array([np.inf if n is None else n for n in found.needed])
        lines[name] = frames, 100.0 * (needed[:, None] <= frames).mean(axis=0)
    return Curves(
        name="frames", title="recovery: trials that are back within a number of frames",
        xlabel="frames after the scrambling", ylabel="share of trials [%]", lines=lines,
        y_range=(0.0, 100.0),
    )  # fmt: skip


def _true_pose(frame: DepthFrame) -> Float:
    """The true pose of a synthetic frame, shape (28,)."""
    assert frame.truth is not None and frame.truth.pose is not None
    return frame.truth.pose
