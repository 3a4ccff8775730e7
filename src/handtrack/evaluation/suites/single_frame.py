"""Suite `single-frame`: frames without memory, of subjects never trained on, from any viewpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import InputError
from handtrack.evaluation.metrics import success_curve
from handtrack.evaluation.runner import Run, bench_case, join_runs, run_tracker
from handtrack.evaluation.suites.suite import (
    Curves,
    Overlay,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
)
from handtrack.hand.kinematics import palm_centre
from handtrack.hand.model import HandModel
from handtrack.synthesis.dataset import DatasetBatch, DatasetConfig, SyntheticDataset
from handtrack.tracking.tracker import HandTracker
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]

_LIMIT_MM = 80.0
"""Right end of the curves [mm]."""

_CLOSE_MM = 40.0
"""Mean error up to which pictures show the hand from near [mm]."""


def single_frame_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/single_frame.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    found, overlays = [], []
    worst: dict[str, tuple[Float, Float]] = {}
    mean: dict[str, tuple[Float, Float]] = {}
    distances = np.linspace(0.0, _LIMIT_MM, 401)
    trackers: dict[str, HandTracker] = {}
    for variant in data["variants"]:
        dataset = _dataset(variant, data, settings)
        runs, facing = _track(variant["case"], dataset, data, trackers, settings, model)
        for tracker, run in runs.items():
            found.append(_case(variant["case"], tracker, run, facing, data, settings))
            name, errors = f"{variant['case']}, {tracker}", run.errors_mm
            worst[name] = distances, 100.0 * success_curve(errors, distances)
            means = errors.mean(axis=1, keepdims=True)
            mean[name] = distances, 100.0 * success_curve(means, distances)
            overlays += _overlays(variant["case"], tracker, run, dataset, data, settings, model)
    return SuiteResult(
        suite="single-frame",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        curves=[
            Curves(
                name=name, title=f"single-frame: frames whose {what} is within a distance",
                xlabel="distance [mm]", ylabel="share of frames [%]", lines=lines,
                y_range=(0.0, 100.0),
            )
            for name, what, lines in (
                ("mean", "mean keypoint error", mean), ("worst", "worst keypoint", worst)
            )
        ],
        overlays=overlays,
        notes=[
            f"shape {settings.shape}; every frame by itself; subjects drawn with seed "
            f"{data['seed'] + settings.seed}",
            f"facing: palm or back of the hand within {data['facing_degrees']:g} degrees of the "
            "direction to the camera",
        ],
    )  # fmt: skip


def facing_camera(poses: ArrayLike, keypoints: ArrayLike, degrees: float) -> NDArray[np.bool_]:
    """Whether the palm or the back of the hand faces the camera.

    Args:
        poses: True poses, shape (n, 28).
        keypoints: True keypoints [m], shape (n, 21, 3), camera frame.
        degrees: Largest angle between the palm's normal, or its opposite, and the direction from
            the palm to the camera.

    Returns:
        Shape (n,).
    """
    normals = quat_to_matrix(np.asarray(poses, np.float64)[:, 3:7])[..., 1]
    middle = palm_centre(keypoints)
    cosine = (normals * middle).sum(axis=-1) / np.linalg.norm(middle, axis=-1)
    return np.abs(cosine) >= np.cos(np.radians(degrees))


def _dataset(
    variant: Mapping[str, Any], data: Mapping[str, Any], settings: SuiteSettings
) -> SyntheticDataset:
    """The frames of a variant, made when they are asked for."""
    sizes = {key: int(data[key]) for key in ("subjects", "poses", "viewpoints")}
    more = {key: value for key, value in variant.items() if key != "case"}
    try:
        config = DatasetConfig(seed=data["seed"] + settings.seed, **sizes, **more)
    except TypeError as error:
        raise InputError(f"variant {variant['case']!r} of single-frame: {error}") from None
    return SyntheticDataset(config, device=settings.device)


def _track(
    case: str,
    dataset: SyntheticDataset,
    data: Mapping[str, Any],
    trackers: dict[str, HandTracker],
    settings: SuiteSettings,
    model: HandModel,
) -> tuple[dict[str, Run], NDArray[np.bool_]]:
    """Track all frames of a variant, one subject after the other.

    Args:
        case: Name of the variant.
        dataset: Its frames.
        data: The suite's `trackers` and `facing_degrees`.
        trackers: Trackers with the mean hand by name; those that are missing are added.
        settings: Device, seed, and whether trackers know the shape.
        model: The parametric hand.

    Returns:
        What each tracker found, and the frames in which the hand faces the camera, shape (n,).

    Raises:
        InputError: A tracker does not start by itself.
    """
    config = dataset.config
    each = config.poses * config.viewpoints
    runs: dict[str, list[Run]] = {name: [] for name in data["trackers"]}
    facing = []
    for subject in settings.progress(range(config.subjects), config.subjects, case):
        batch = dataset.render(range(subject * each, (subject + 1) * each))
        facing.append(facing_camera(batch.poses, batch.keypoints, data["facing_degrees"]))
        shape = dataset.shape(subject) if settings.shape == "given" else None
        for name, before in runs.items():
            if shape is not None or name not in trackers:
                trackers[name] = HandTracker(
                    config.camera, side=config.side, shape=shape, device=settings.device,
                    tracker=name, seed=settings.seed, model=model,
                )  # fmt: skip
            if not trackers[name].automatic:
                raise InputError(
                    f"{name} needs a first pose, and the suite single-frame gives none: choose a "
                    "tracker that finds the hand by itself"
                )
            before.append(run_tracker(trackers[name], _frames(batch, config), {}, memory=False))
    return {name: join_runs(parts) for name, parts in runs.items()}, np.concatenate(facing)


def _frames(batch: DatasetBatch, config: DatasetConfig) -> list[DepthFrame]:
    """Samples as frames with truth."""
    samples = zip(batch.indices, batch.depth, batch.keypoints, batch.poses, strict=True)
    return [
        DepthFrame(
            depth=depth, camera=config.camera, index=int(number), name=f"sample {number}",
            truth=FrameTruth(keypoints=points, pose=pose, side=config.side),
        )
        for number, depth, points, pose in samples
    ]  # fmt: skip


def _case(
    case: str,
    tracker: str,
    run: Run,
    facing: NDArray[np.bool_],
    data: Mapping[str, Any],
    settings: SuiteSettings,
) -> dict[str, Any]:
    """The case of one variant with one tracker."""
    within = run.frame_errors_mm < data["success_mm"]
    key = f"within_{data['success_mm']:g}mm"
    more: dict[str, Any] = {"shape": settings.shape, key: float(within.mean())}
    more["facing_frames"] = int(facing.sum())
    if facing.any():
        more[f"facing_{key}"] = float(within[facing].mean())
    return bench_case(run, case=case, tracker=tracker, **more)


def _overlays(
    case: str,
    tracker: str,
    run: Run,
    dataset: SyntheticDataset,
    data: Mapping[str, Any],
    settings: SuiteSettings,
    model: HandModel,
) -> list[Overlay]:
    """The worst frames, and some at random, drawn again for the pictures."""
    count = min(int(data["pictures"]), len(run))
    rng = np.random.default_rng(data["seed"])
    picked = {
        "worst": np.argsort(-run.frame_errors_mm, kind="stable")[:count],
        "random": np.sort(rng.choice(len(run), count, replace=False)),
    }
    found = []
    for kind, places in picked.items():
        # Numbers of the samples in the data set are places in the run.
        batch = dataset.render(places.tolist())
        for rank, (place, depth) in enumerate(zip(places.tolist(), batch.depth, strict=True)):
            shape = dataset.shape(int(batch.subject[rank])) if settings.shape == "given" else None
            state, error = run.states[place].value.replace("_", " "), run.frame_errors_mm[place]
            found.append(
                Overlay(
                    name=f"single-frame-{case.replace(' ', '-')}-{tracker}-{kind}-{rank + 1:02d}",
                    depth=depth, camera=dataset.config.camera,
                    hand=model.shaped(shape, side=dataset.config.side), pose=run.poses[place],
                    text=f"sample {place}: {state}, {error:.1f} mm",
                    # Where a hand was taken for something else is seen in the whole image.
                    zoom=None if error > _CLOSE_MM else 0.35,
                )
            )  # fmt: skip
    return found
