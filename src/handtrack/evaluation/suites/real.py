"""Suite `real`: real images, measured by labelled joints (NYU protocol) or labelled fingertips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.camera.readers.png_folder import read_json
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.metrics import MISSING_ERROR_MM, keypoint_errors, summarize
from handtrack.evaluation.nyu import PROTOCOL_JOINTS, nyu_joints, start_pose_from_joints
from handtrack.evaluation.runner import Run, bench_case, join_runs, run_tracker
from handtrack.evaluation.suites.suite import (
    Overlay,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import FINGERS, TIP_KEYPOINTS
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]

JOINT_SET = "nyu36"
"""Joint set from which an image can be started."""

TIPS = "fingertips"
"""Case over all images with labelled fingertips."""

_CLOSE_MM = 40.0
"""Mean error up to which pictures show the hand from near [mm]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledImage:
    """One image and what is known of it."""

    name: str
    frame: DepthFrame
    side: str
    joints: Float | None = None
    """NYU's joints [m], shape (36, 3)."""
    tips: dict[str, Float] | None = None
    """Finger -> pixel of its tip, shape (2,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tracked:
    """What a tracker found in an image."""

    image: LabelledImage
    tracker: str
    run: Run
    hand: ShapedHand
    start: Float | None
    """Pose given at the start, shape (28,); None for none."""
    scale: float | None
    """Overall scale of the hand that the tracker was told; None for the mean hand."""
    size: float
    """Scale that the tracker has come to, against the hand that it was told."""

    @property
    def facts(self) -> dict[str, Any]:
        """Entries of the case that say what the tracker was told."""
        return {
            "scale": self.size * (1.0 if self.scale is None else self.scale),
            "shape": "mean" if self.scale is None else "given",
            "side": self.image.side,
        }


def real_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/real.toml`."""
    data = chosen(settings, cases)
    if settings.data is None:
        raise InputError("the suite real needs the folder with the recordings: --data DIR")
    folder = images_folder(settings.data, data)
    model = HandModel.load()
    images = [_labelled(folder, name) for name in data["labelled"]]
    images += [image_with_tips(folder, name) for name in data["fingertips"]]
    images += [_read(folder, name) for name in data["pictured"]]
    found, overlays, notes, errors = [], [], [], {}
    for name in data["trackers"]:
        tracked = [_track(image, name, int(data["repeats"]), settings, model) for image in images]
        for one in tracked:
            if one is None:
                continue
            if one.image.joints is not None:
                case, joint_errors = _joint_case(one, one.image.joints)
                errors[f"{one.image.name}, {name}"] = joint_errors
                notes.append(_joint_note(case))
            elif one.image.tips is not None:
                case = _tip_case(one, one.image.tips, data)
            else:
                case = bench_case(one.run, case=one.image.name, tracker=name, **one.facts)
            found.append(case)
            overlays += _overlays(one, case)
        with_tips = [one for one in tracked if one is not None and one.image.tips is not None]
        if with_tips:
            found.append(_all_tips(name, with_tips, found))
        left_out = [image.name for image, one in zip(images, tracked, strict=True) if one is None]
        if left_out:
            notes.append(
                f"{name} is not startable, for their labels do not tell a pose (fingertips in "
                f"pixels at most): {', '.join(left_out)}"
            )
    return SuiteResult(
        suite="real",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        overlays=overlays,
        notes=notes,
    )


def _track(
    image: LabelledImage, name: str, repeats: int, settings: SuiteSettings, model: HandModel
) -> _Tracked | None:
    """Track an image as a still sequence; None when the tracker needs a start that there is not."""

    def make(shape: HandShape | None) -> HandTracker:
        return HandTracker(
            image.frame.camera, side=image.side, shape=shape, device=settings.device, tracker=name,
            seed=settings.seed, model=model,
        )  # fmt: skip

    tracker, start, scale = make(None), None, None
    if not tracker.automatic or settings.shape == "given":
        if image.joints is not None:
            start, scale = start_pose_from_joints(model, image.joints, side=image.side)
            tracker = make(HandShape(scale=scale))
        elif not tracker.automatic:
            return None
    starts = {} if start is None or tracker.automatic else {0: start}
    run = run_tracker(
        tracker, [image.frame] * repeats, starts, progress=settings.progress,
        text=f"{image.name}, {name}",
    )  # fmt: skip
    return _Tracked(
        image=image,
        tracker=name,
        run=run,
        hand=tracker.hand,
        start=starts.get(0),
        scale=scale,
        size=tracker.size,
    )


# Labelled joints


def _joint_case(one: _Tracked, labels: Float) -> tuple[dict[str, Any], Float]:
    """Case of an image with joints, and their errors at the start and in every repeat [mm]."""
    poses = one.run.poses if one.start is None else np.stack([one.start, *one.run.poses])
    joints, truth = nyu_joints(one.hand, poses), labels[PROTOCOL_JOINTS]
    errors = keypoint_errors(joints, np.broadcast_to(truth, joints.shape))
    accuracy = summarize(joints[-1:], truth[None]).to_dict()
    more = {key: accuracy[key] for key in ("keypoint_error_mm", "success_rate", "lost_rate")}
    more |= {"joint_set": "nyu14", "first_error_mm": float(errors[-len(one.run)].mean())}
    if one.start is not None:
        more["start_error_mm"] = float(errors[0].mean())
    case = bench_case(one.run, case=one.image.name, tracker=one.tracker, **more, **one.facts)
    return case, errors


def _joint_note(case: Mapping[str, Any]) -> str:
    """How far the joints were from the labels."""
    start = "no pose given"
    if "start_error_mm" in case:
        start = f"{case['start_error_mm']:.2f} mm at the start (inverse kinematics)"
    return (
        f"{case['case']}, {case['tracker']}: {start}, {case['scale']:.3f} times the mean hand, "
        f"{case['first_error_mm']:.2f} mm after the first frame, "
        f"{case['keypoint_error_mm']['mean']:.2f} mm in the end"
    )


# Labelled fingertips


def tip_errors(keypoints: Float, camera: Camera, tips: Mapping[str, Float]) -> dict[str, float]:
    """How far fingertips lie from their labels sideways, at their own depth.

    Args:
        keypoints: Keypoints found [m], shape (21, 3), NaN for none.
        camera: Camera of the image.
        tips: Finger -> pixel of its labelled tip, shape (2,).

    Returns:
        Finger -> distance [mm], `MISSING_ERROR_MM` where there is no keypoint before the camera.
    """
    found = {}
    for finger, pixel in tips.items():
        point = keypoints[TIP_KEYPOINTS[FINGERS.index(finger)]]
        off = (camera.project(point) - pixel) * point[2] / np.array([camera.fx, camera.fy])
        distance = 1e3 * float(np.linalg.norm(off))
        found[finger] = distance if np.isfinite(distance) else MISSING_ERROR_MM
    return found


def _tip_case(one: _Tracked, tips: Mapping[str, Float], data: Mapping[str, Any]) -> dict[str, Any]:
    """Case of an image with fingertips, after the first frame and in the end."""
    more: dict[str, Any] = {}
    for key, place in (("first_tip_error_mm", 0), ("tip_error_mm", -1)):
        errors = tip_errors(one.run.keypoints[place], one.image.frame.camera, tips)
        distances = list(errors.values())
        more[key] = {"mean": float(np.mean(distances)), "max": max(distances), **errors}
    more |= {
        "tips_within": more["tip_error_mm"]["max"] <= data["tips_mm"],
        "found": bool(one.run.sure[-1]) and more["tip_error_mm"]["mean"] < data["found_mm"],
    }
    return bench_case(one.run, case=one.image.name, tracker=one.tracker, **more, **one.facts)


def _all_tips(
    tracker: str, tracked: Sequence[_Tracked], cases: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Case over all images with fingertips."""
    names = {one.image.name for one in tracked}
    parts = [case for case in cases if case["tracker"] == tracker and case["case"] in names]
    return bench_case(
        join_runs([one.run for one in tracked]),
        case=TIPS,
        tracker=tracker,
        images=len(parts),
        images_found=sum(case["found"] for case in parts),
        images_within=sum(case["tips_within"] for case in parts),
        **{
            key: {
                "mean": float(np.mean([case[key]["mean"] for case in parts])),
                "max": max(case[key]["max"] for case in parts),
            }
            for key in ("first_tip_error_mm", "tip_error_mm")
        },
    )


# Pictures and files


def _overlays(one: _Tracked, case: Mapping[str, Any]) -> list[Overlay]:
    """The given or the first pose, and the last one."""
    told = [("first", one.run.poses[0], "first_"), ("fitted", one.run.poses[-1], "")]
    if one.start is not None:
        told[0] = ("start", one.start, "start_")
    found = []
    for when, pose, prefix in told:
        text, error = when, 0.0
        if one.image.joints is not None:
            error = case.get(f"{prefix}error_mm", case["keypoint_error_mm"]["mean"])
            text = f"{when}: {error:.1f} mm"
        elif one.image.tips is not None:
            errors = case[f"{prefix}tip_error_mm"]
            error = errors["mean"]
            text = f"{when}: tips {error:.1f} mm, at most {errors['max']:.1f} mm"
        found.append(
            Overlay(
                name=f"{one.image.name}-{one.tracker}-{when}", depth=one.image.frame.depth,
                camera=one.image.frame.camera, hand=one.hand, pose=pose, text=text,
                # Where a hand was taken for something else is seen in the whole image.
                zoom=None if error > _CLOSE_MM else 0.35,
            )
        )  # fmt: skip
    return found


def images_folder(recordings: Path, data: Mapping[str, Any]) -> Path:
    """The folder that the suite's data name among the recordings; that of all, when there is none.

    Args:
        recordings: The user's folder.
        data: The suite's `folder`.
    """
    folder = recordings / data["folder"]
    return folder if folder.is_dir() else recordings


def _read(folder: Path, name: str) -> LabelledImage:
    """An image, with what its labels say of the side."""
    path = folder / f"{name}.png"
    with open_sequence(path) as sequence:
        frame = next(iter(sequence))
    if frame.problem is not None:
        raise MissingFileError(f"{path} cannot be used: {frame.problem}")
    side = frame.truth.side if frame.truth is not None else None
    return LabelledImage(name=name, frame=frame, side=side or "right")


def _labelled(folder: Path, name: str) -> LabelledImage:
    """An image with the joints of the NYU data set."""
    image = _read(folder, name)
    truth = image.frame.truth
    if truth is None or truth.joints is None or truth.joint_set != JOINT_SET:
        raise InputError(f"{folder / name}.png carries no {JOINT_SET} joints in {name}.json")
    return LabelledImage(
        name=name, frame=image.frame, side=image.side, joints=truth.joints.astype(np.float64)
    )


def image_with_tips(folder: Path, name: str) -> LabelledImage:
    """An image with fingertips labelled in pixels."""
    image = _read(folder, name)
    path = folder / f"{name}.json"
    labels = read_json(path).get("fingertips_px")
    if not isinstance(labels, dict) or not labels:
        raise InputError(f"{path} carries no fingertips_px")
    tips = {}
    for finger, pixel in labels.items():
        try:
            place = np.array(pixel, np.float64)
        except (TypeError, ValueError):
            place = np.empty(0)
        if finger not in FINGERS or place.shape != (2,) or not np.isfinite(place).all():
            raise DamagedFileError(
                f"fingertips_px in {path} has {finger!r}: {pixel!r}; expected one of "
                f"{', '.join(FINGERS)} and a pixel u v"
            )
        tips[finger] = place
    return LabelledImage(name=name, frame=image.frame, side=image.side, tips=tips)
