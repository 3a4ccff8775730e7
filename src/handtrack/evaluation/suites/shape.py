"""Suite `shape`: the shape fitted to images, found while tracking, and fitted to real images."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.evaluation.suites.calibration_images import calibration_images
from handtrack.evaluation.suites.real import image_with_tips, images_folder, tip_errors
from handtrack.evaluation.suites.subjects import motion_of
from handtrack.evaluation.suites.suite import (
    Curves,
    Overlay,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.evaluation.surfaces import rest_surface_distance
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.synthesis.subjects import UnseenSubjects
from handtrack.tracking.shape_calibration import Calibration, calibrate
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]

_STILL_MM = 0.3
"""A shape has converged when its bones stay within so much of their final length on average."""

_MIDDLE_TIP = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeError:
    """How far a hand is from the true one [mm]."""

    bones: Float
    """Error of each bone's length, shape (16,)."""
    surface: float
    """Mean distance of the skins in the rest pose."""
    length: float
    """Error of the length from the wrist joint to the tip of the straight middle finger."""

    @classmethod
    def of(cls, hand: ShapedHand, truth: ShapedHand) -> ShapeError:
        """Compare two hands."""
        return cls(
            bones=1e3 * np.abs(hand.bone_lengths - truth.bone_lengths),
            surface=1e3 * rest_surface_distance(hand, truth),
            length=1e3 * abs(hand_length(hand) - hand_length(truth)),
        )


def hand_length(hand: ShapedHand) -> float:
    """From the wrist joint to the tip of the straight middle finger [m]."""
    straight = np.zeros(28)
    straight[3] = 1.0
    return float(np.linalg.norm(keypoints(hand, straight)[_MIDDLE_TIP]))


def shape_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/shape.toml`."""
    data = chosen(settings, cases)
    model, subjects = HandModel.load(), UnseenSubjects.load()
    found, overlays, notes = _calibrated(data, settings, model, subjects)
    online = data["online"]
    curves = []
    if online["subjects"]:
        more, lines = _online(online, settings, model, subjects)
        found += more
        curves.append(Curves(
            name="online", title="shape: error while tracking", xlabel="frame",
            ylabel="mean error of bone lengths [mm]", lines=lines,
        ))  # fmt: skip
    if settings.data is not None:
        more, pictures = _real(data["real"], settings, model)
        found += more
        overlays += pictures
    else:
        notes.append("real images left out: they need --data DIR")
    return SuiteResult(
        suite="shape",
        cases=found,
        targets=judged(found, data["targets"], "fit_shape"),
        curves=curves,
        overlays=overlays,
        notes=notes,
    )


def _case(case: str, tracker: str, errors: Sequence[ShapeError], **more: Any) -> dict[str, Any]:
    """Case of several hands."""

    def told(values: Float) -> dict[str, float]:
        return {"mean": float(values.mean()), "p95": float(np.percentile(values, 95))}

    return {
        "case": case, "tracker": tracker, "subjects": len(errors),
        "bone_length_error_mm": told(np.stack([one.bones for one in errors])),
        "surface_error_mm": told(np.array([one.surface for one in errors])),
        "hand_length_error_mm": told(np.array([one.length for one in errors])),
        **more,
    }  # fmt: skip


# Fitted to images


def _calibrated(
    data: Mapping[str, Any], settings: SuiteSettings, model: HandModel, subjects: UnseenSubjects
) -> tuple[list[dict[str, Any]], list[Overlay], list[str]]:
    """Cases `fitted` and `mean-hand`, pictures, notes."""
    mean = model.shaped()
    fitted, before, seconds, overlays = [], [], [], []
    within, warned, frames = [], 0, 0
    numbers = data["subjects"]
    for number in settings.progress(numbers, len(numbers), "fitting"):
        truth = subjects.hand(number, model)
        images = calibration_images(truth, data, [settings.seed, number], device=settings.device)
        begin = time.perf_counter()
        fit = calibrate(
            images.depths, images.camera, device=settings.device, seed=settings.seed, model=model
        )
        seconds.append(time.perf_counter() - begin)
        frames += len(images.depths)
        fitted.append(ShapeError.of(fit.hand, truth))
        before.append(ShapeError.of(mean, truth))
        within.append(fitted[-1].bones < 1e3 * fit.certainty.lengths)
        warned += fit.shape.problem is not None
        if len(overlays) < 2 * data["pictures"] * len(images.depths):
            overlays += _before_and_after(f"shape-subject-{number:02d}", fit, images.camera, mean)
    told = {
        "seconds": {"mean": float(np.mean(seconds)), "max": max(seconds)},
        "within_one_sigma": float(np.mean(within)),
        "warned": warned,
    }
    cases = [
        _case("fitted", "fit_shape", fitted, frames=frames, **told),
        _case("mean-hand", "none", before, frames=frames, seconds={"mean": 0.0, "max": 0.0}),
    ]
    return cases, overlays, [
        f"{len(numbers)} subjects that the model was not learnt from, {len(data['poses'])} images "
        f"each at {data['distance'][0]} to {data['distance'][1]} m, noise {data['noise']}; "
        "surfaces compared in palm frames as they are",
    ]  # fmt: skip


def _before_and_after(
    name: str, fit: Calibration, camera: Camera, mean: ShapedHand
) -> list[Overlay]:
    """The mean hand and the fitted one over every image."""
    return [
        Overlay(
            name=f"{name}-{image}-{when}", depth=fit.depths[image], camera=camera, hand=hand,
            pose=poses[image], text=f"{when}: depth error {1e3 * errors[image]:.1f} mm",
        )
        for image in range(len(fit.depths))
        for when, hand, poses, errors in (
            ("before", mean, fit.mean_poses, fit.mean_errors),
            ("after", fit.hand, fit.poses, fit.errors),
        )
    ]  # fmt: skip


# While tracking


def _online(
    data: Mapping[str, Any], settings: SuiteSettings, model: HandModel, subjects: UnseenSubjects
) -> tuple[list[dict[str, Any]], dict[str, tuple[Float, Float]]]:
    """Cases `online` of adaption and of the offline fit to the same frames, and curves."""
    mean = model.shaped()
    adapted, offline, before, converged, frozen, slowest, lines = [], [], [], [], [], [], {}
    camera, motion = Camera.from_dict(data["camera"]), motion_of(data)
    for number in settings.progress(data["subjects"], len(data["subjects"]), "adapting"):
        truth = subjects.hand(number, model)
        frames = [frame.depth for frame in synthesize_sequence(
            motion, truth, camera, noise_preset(data["noise"]), seed=settings.seed,
            device=settings.device,
        )]  # fmt: skip
        tracker = HandTracker(
            camera, device=settings.device, seed=settings.seed, model=model, adapt_shape=True
        )
        lengths, times, sure = [], [], len(frames)
        for place, depth in enumerate(frames):
            result = tracker.track(depth)
            lengths.append(tracker.hand.bone_lengths)
            times.append(result.timings.get("total", 0.0))
            if tracker.shape_frozen:
                sure = min(sure, place + 1)
        away = 1e3 * np.abs(np.array(lengths) - lengths[-1]).mean(axis=1)
        moving = np.flatnonzero(away > _STILL_MM)
        converged.append(int(moving[-1]) + 2 if len(moving) else 1)
        frozen.append(sure)
        slowest.append(float(np.percentile(times, 95)))
        adapted.append(ShapeError.of(tracker.hand, truth))
        fit = calibrate(frames, camera, device=settings.device, seed=settings.seed, model=model)
        offline.append(ShapeError.of(fit.hand, truth))
        before.append(ShapeError.of(mean, truth))
        lines[f"subject {number}"] = (
            np.arange(len(frames), dtype=np.float64),
            1e3 * np.abs(np.array(lengths) - truth.bone_lengths).mean(axis=1),
        )
    count = len(motion) * len(adapted)
    ratio = np.mean([e.bones.mean() for e in adapted]) / np.mean([e.bones.mean() for e in offline])
    return [
        _case(
            "online", "adapted", adapted, frames=count,
            converged_frames={"mean": float(np.mean(converged)), "max": max(converged)},
            frozen_frames={"mean": float(np.mean(frozen)), "max": max(frozen)},
            error_against_offline=float(ratio), frame_ms={"p95": float(np.mean(slowest))},
        ),
        _case("online", "fit_shape", offline, frames=count),
        _case("online", "none", before, frames=count),
    ], lines  # fmt: skip


# Real images


def _real(
    data: Mapping[str, Any], settings: SuiteSettings, model: HandModel
) -> tuple[list[dict[str, Any]], list[Overlay]]:
    """Cases `real` with the mean hand and with the shape fitted to the other images."""
    assert settings.data is not None
    folder = images_folder(settings.data, data)
    halves = [[image_with_tips(folder, name) for name in half] for half in data["halves"]]
    errors: dict[str, list[tuple[float, float]]] = {"mean-hand": [], "size": [], "fitted": []}
    overlays = []
    for place, half in enumerate(halves):
        others = halves[1 - place]
        fit = calibrate(
            [image.frame.depth for image in others], others[0].frame.camera,
            side=others[0].side, device=settings.device, seed=settings.seed, model=model,
        )  # fmt: skip
        # The mean hand, at its own size or at the size that is found, and the fitted one.
        shapes = {"mean-hand": HandShape(), "size": None, "fitted": fit.shape}
        for name, shape in shapes.items():
            for image in half:
                tracker = HandTracker(
                    image.frame.camera, side=image.side, shape=shape, device=settings.device,
                    seed=settings.seed, model=model,
                )  # fmt: skip
                for _ in range(data["repeats"]):
                    result = tracker.track(image.frame.depth)
                assert image.tips is not None
                tips = tip_errors(
                    result.keypoints.astype(np.float64), image.frame.camera, image.tips
                )
                errors[name].append((1e3 * result.depth_error, float(np.mean(list(tips.values())))))
                overlays.append(Overlay(
                    name=f"shape-{image.name}-{name}", depth=image.frame.depth,
                    camera=image.frame.camera, hand=tracker.hand, pose=result.pose,
                    text=f"{name}: depth {1e3 * result.depth_error:.1f} mm, tips "
                    f"{errors[name][-1][1]:.1f} mm",
                ))  # fmt: skip
    cases = []
    for name, found in errors.items():
        depth, tips = np.array(found).T
        cases.append({
            "case": "real", "tracker": name, "frames": len(found),
            "depth_error_mm": {"mean": float(depth.mean())},
            "tip_error_mm": {"mean": float(tips.mean()), "max": float(tips.max())},
        })  # fmt: skip
    return cases, overlays
