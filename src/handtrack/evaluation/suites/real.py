"""Suite `real`: labelled real images, started from their labels, measured by the NYU protocol."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.camera.source import open_sequence
from handtrack.errors import InputError, MissingFileError
from handtrack.evaluation.metrics import keypoint_errors, summarize
from handtrack.evaluation.nyu import PROTOCOL_JOINTS, nyu_joints, start_pose_from_joints
from handtrack.evaluation.runner import bench_case, run_tracker
from handtrack.evaluation.suites.suite import (
    Overlay,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.tracking.tracker import HandTracker

JOINT_SET = "nyu36"
"""Joint set from which an image can be started."""


def real_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/real.toml`."""
    data = chosen(settings, cases)
    if settings.data is None:
        raise InputError("the suite real needs the folder with the recordings: --data DIR")
    folder = settings.data / data["folder"]
    if not folder.is_dir():
        folder = settings.data
    model = HandModel.load()
    found, overlays, errors = [], [], {}
    for name in data["labelled"]:
        frame = _labelled(folder / f"{name}.png")
        for tracker in data["trackers"]:
            case, pictures, joints = _measure(
                name, frame, tracker, int(data["repeats"]), settings, model
            )
            found.append(case)
            overlays += pictures
            errors[f"{name}, {tracker}"] = joints
    return SuiteResult(
        suite="real",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        overlays=overlays,
        notes=[_start_note(case) for case in found] + _not_startable(folder, data["labelled"]),
    )


def _measure(
    name: str,
    frame: DepthFrame,
    tracker: str,
    repeats: int,
    settings: SuiteSettings,
    model: HandModel,
) -> tuple[dict[str, Any], list[Overlay], NDArray[np.float64]]:
    """One image with one tracker: case, pictures before and after, errors of every repeat [mm]."""
    assert frame.truth is not None and frame.truth.joints is not None
    side = frame.truth.side or "right"
    labels = frame.truth.joints.astype(np.float64)
    start, scale = start_pose_from_joints(model, labels, side=side)
    made = HandTracker(
        frame.camera, side=side, shape=HandShape(scale=scale), device=settings.device,
        tracker=tracker, seed=settings.seed, model=model,
    )  # fmt: skip
    run = run_tracker(made, [frame] * repeats, {0: start}, progress=settings.progress, text=name)
    truth = labels[PROTOCOL_JOINTS]
    joints = nyu_joints(made.hand, np.concatenate([start[None], run.poses]))
    joint_errors = keypoint_errors(joints, np.broadcast_to(truth, joints.shape))
    before, after = joint_errors[0].mean(), joint_errors[-1].mean()
    accuracy = summarize(joints[-1:], truth[None]).to_dict()
    case = bench_case(
        run, case=name, tracker=tracker,
        **{key: accuracy[key] for key in ("keypoint_error_mm", "success_rate", "lost_rate")},
        joint_set="nyu14", start_error_mm=float(before), scale=scale, side=side,
    )  # fmt: skip
    pictures = [
        Overlay(
            name=f"{name}-{tracker}-{when}", depth=frame.depth, camera=frame.camera,
            hand=made.hand, pose=pose, text=f"{when}: {error:.1f} mm",
        )
        for when, pose, error in (("start", start, before), ("fitted", run.poses[-1], after))
    ]  # fmt: skip
    return case, pictures, joint_errors


def _labelled(path: Path) -> DepthFrame:
    """An image with its labels."""
    with open_sequence(path) as sequence:
        frame = next(iter(sequence))
    if frame.problem is not None:
        raise MissingFileError(f"{path} cannot be used: {frame.problem}")
    if frame.truth is None or frame.truth.joints is None or frame.truth.joint_set != JOINT_SET:
        raise InputError(
            f"{path} carries no {JOINT_SET} joints in {path.with_suffix('.json').name}"
        )
    return frame


def _start_note(case: Mapping[str, Any]) -> str:
    """How far the start was from the labels."""
    return (
        f"{case['case']}, {case['tracker']}: {case['start_error_mm']:.2f} mm at the start (inverse "
        f"kinematics, {case['scale']:.3f} times the mean hand), "
        f"{case['keypoint_error_mm']['mean']:.2f} mm fitted"
    )


def _not_startable(folder: Path, labelled: list[str]) -> list[str]:
    """Which images beside the labelled ones there are, and why they are not measured."""
    others = sorted(path.stem for path in folder.glob("*.png") if path.stem not in labelled)
    if not others:
        return []
    return [
        f"not startable, for their labels do not tell a pose (fingertips in pixels at most): "
        f"{', '.join(others)}"
    ]
