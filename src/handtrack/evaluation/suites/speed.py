"""Suite `speed`: time per frame and stage of the fit by the number of hypotheses, and start-up."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame, check_depth
from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.evaluation.metrics import summarize
from handtrack.evaluation.runner import true_keypoints
from handtrack.evaluation.suites.stages import StagedFitter
from handtrack.evaluation.suites.start_up import measure_start
from handtrack.evaluation.suites.subjects import SubjectFrames, render_subject
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.evaluation.timing import StageTimer
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.skeleton import NQ, NV
from handtrack.priors.gaussian import GaussianPrior
from handtrack.tracking.tracker import TRACKERS
from handtrack.transforms import apply_increment

_STAGED_FRAMES = 20
"""Frames on which stages are timed."""

_STAGED_ROWS = 1024
"""So many rows at most are staged in sum, so that many hypotheses do not take many times as
long."""


def speed_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/speed.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    subject = render_subject(data, data["subjects"][0], settings, model)
    hand = model.shaped(subject.shape)
    found = []
    for tracker in data["trackers"]:
        sized = [
            _measure(tracker, rows, subject, hand, data, settings)
            for rows in settings.progress(data["rows"], len(data["rows"]), tracker)
        ]
        _add_costs(sized)
        found += sized
    device = resolve_device(settings.device)
    started = {"warm": measure_start(device.alias, cold=False)}
    if settings.cold:
        started["cold"] = measure_start(device.alias, cold=True)
    notes = [
        f"{kind} start: {sum(spent.values()):.1f} s to the first result, "
        + ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in spent.items())
        for kind, spent in started.items()
    ]
    notes += [
        f"{case['tracker']}: {case['added_hypothesis_ms']:.3f} ms per added hypothesis, from 1 to "
        f"{case['rows']}"
        for case in found
        if case["rows"] == max(data["rows"]) and "added_hypothesis_ms" in case
    ]
    notes.append("stages are timed one by one, so their sum is a little over the frame's time")
    return SuiteResult(
        suite="speed",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        notes=notes,
        more={"start_seconds": started},
    )


def _measure(
    tracker: str,
    rows: int,
    subject: SubjectFrames,
    hand: ShapedHand,
    data: Mapping[str, Any],
    settings: SuiteSettings,
) -> dict[str, Any]:
    """The case of one number of hypotheses."""
    fit = getattr(TRACKERS[tracker], "fit", None)
    if fit is None:
        raise InputError(f"the tracker {tracker!r} fits nothing whose speed could be measured")
    config = replace(fit, iterations=int(data["iterations"]))
    prior = GaussianPrior.load() if config.prior_weight > 0 else None
    camera = subject.frames[0].camera
    fitter = StagedFitter(
        [hand], camera, config=config, nhyp=rows, device=settings.device, prior=prior
    )
    frames = subject.frames[1:]
    starts = _start_poses(subject.frames, rows, data["shaken"], settings.seed)
    buffer = np.zeros(camera.shape, np.float32)
    for _ in range(2):
        _fit(fitter, hand, frames[0], starts[0], buffer)

    timer, found = StageTimer(), []
    until = time.perf_counter() + float(data["seconds"])
    while not found or time.perf_counter() < until:
        for frame, start in zip(frames, starts, strict=True):
            pose, stages = _fit(fitter, hand, frame, start, buffer)
            timer.add_frame(stages)
            if len(found) < len(frames):
                found.append(pose)
    measured = timer.summary().to_dict()
    staged = _staged(fitter, hand, frames, starts, buffer, rows)
    stages = {key: ms for key, ms in measured.pop("stage_ms").items() if key != "fit"}
    order = ("check", "upload", *staged, "download")
    truth = np.stack([true_keypoints(frame) for frame in frames])
    accuracy = summarize(keypoints(hand, np.stack(found)), truth).to_dict()
    return {
        "case": f"rows-{rows}",
        "tracker": tracker,
        **accuracy,
        "rows": rows,
        "iterations": config.iterations,
        "threads": fitter.threads,
        "workspace_mb": _megabytes(fitter.rows) + _megabytes(fitter.image),
        **measured,
        "frames": len(timer),
        "stage_ms": {key: (stages | staged)[key] for key in order},
    }


def _fit(
    fitter: StagedFitter,
    hand: ShapedHand,
    frame: DepthFrame,
    starts: NDArray[np.float64],
    buffer: NDArray[np.float32],
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """One frame from depth image to best pose: pose, and time per stage [ms]."""
    clock = [time.perf_counter()]
    clean, _ = check_depth(frame.depth, frame.camera, out=buffer)
    clock.append(time.perf_counter())
    _load(fitter, hand, clean, starts)
    clock.append(time.perf_counter())
    fitter.run()
    clock.append(time.perf_counter())
    pose = fitter.poses[int(np.argmin(fitter.errors))].astype(np.float64)
    clock.append(time.perf_counter())
    spans = (1e3 * np.diff(clock)).tolist()
    return pose, dict(zip(("check", "upload", "fit", "download"), spans, strict=True))


def _load(
    fitter: StagedFitter,
    hand: ShapedHand,
    depth: NDArray[np.float32],
    starts: NDArray[np.float64],
) -> None:
    """Bring a frame and its start poses to the device."""
    fitter.load_depth(depth)
    fitter.place(keypoints(hand, starts[0]).mean(axis=0))
    fitter.set_poses(starts)
    wp.synchronize_device(fitter.device)


def _staged(
    fitter: StagedFitter,
    hand: ShapedHand,
    frames: list[DepthFrame],
    starts: list[NDArray[np.float64]],
    buffer: NDArray[np.float32],
    rows: int,
) -> dict[str, float]:
    """Median time of each stage of the fit [ms]."""
    count = min(len(frames), _STAGED_FRAMES, max(2, _STAGED_ROWS // rows))
    spent: list[dict[str, float]] = []
    for frame, start in list(zip(frames, starts, strict=True))[:count]:
        clean, _ = check_depth(frame.depth, frame.camera, out=buffer)
        _load(fitter, hand, clean, start)
        spent.append(fitter.run_staged())
    # The first time captures the graphs.
    return {
        stage: float(np.median([one[stage] for one in spent[1:] or spent])) for stage in spent[0]
    }


def _start_poses(
    frames: list[DepthFrame], rows: int, shaken: list[float], seed: int
) -> list[NDArray[np.float64]]:
    """Start poses of every frame but the first, each of shape (rows, 28)."""
    rng = np.random.default_rng(seed)
    deviations = np.repeat(shaken, (3, 3, NV - 6))
    starts = []
    for frame in frames[:-1]:
        assert frame.truth is not None and frame.truth.pose is not None
        steps = rng.normal(0.0, deviations, (rows, NV))
        # The first hypothesis is the pose of the frame before, as in tracking.
        steps[0] = 0.0
        poses = np.broadcast_to(frame.truth.pose, (rows, NQ))
        starts.append(apply_increment(poses, steps))
    return starts


def _add_costs(sized: list[dict[str, Any]]) -> None:
    """Add to every case what a further hypothesis costs, counted from the smallest case."""
    least = min(sized, key=lambda case: case["rows"])
    for case in sized:
        added = case["rows"] - least["rows"]
        if added:
            more = case["latency_ms"]["p50"] - least["latency_ms"]["p50"]
            case["added_hypothesis_ms"] = max(more, 0.0) / added


def _megabytes(arrays: Any) -> float:
    """Memory of a workspace [MB]."""
    return 1e-6 * sum(getattr(arrays, field.name).capacity for field in fields(arrays))
