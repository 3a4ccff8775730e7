"""Suite `regression`: the regressors alone, cross-validated over subjects (thesis II.6.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.evaluation.metrics import keypoint_errors, success_curve, summarize
from handtrack.evaluation.suites.suite import Curves, SuiteResult, SuiteSettings, chosen
from handtrack.forest.artifact import Forest
from handtrack.forest.cascade import Cascade
from handtrack.forest.config import ForestConfig, TrainingConfig
from handtrack.forest.crops import Cropper, TrainingCrops, crops_of, join_crops
from handtrack.forest.training import ForestTrainer
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset

_BATCH = 50
_LIMIT_MM = 120.0
"""Right end of the curves [mm]."""

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frames:
    """Test frames of one fold."""

    depth: NDArray[np.float32]
    truth: Float
    subjects: NDArray[np.int32]
    centres: Float


def regression_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/regression.toml`."""
    data = chosen(settings, cases)
    if settings.trackers:
        raise InputError("the suite regression trains its own forests; leave out --tracker")
    config = DatasetConfig(
        seed=data["seed"] + settings.seed, subjects=int(data["subjects"]),
        poses=int(data["poses"]), viewpoints=int(data["viewpoints"]),
    )  # fmt: skip
    dataset = SyntheticDataset(config, device=settings.device)
    subjects = dataset.subjects()
    found: dict[str, list[Float]] = {variant["case"]: [] for variant in data["variants"]}
    truth: list[Float] = []
    seconds = dict.fromkeys(found, 0.0)
    folds = int(data["folds"])
    for fold in range(folds):
        mine = np.arange(config.subjects) % folds == fold
        frames = _test_frames(dataset, mine, int(data["test_frames"]), settings)
        crops = _crops(dataset, ~mine, settings, f"rendering for fold {fold + 1}")
        truth.append(frames.truth)
        for variant in data["variants"]:
            forest = ForestConfig(**{key: value for key, value in variant.items() if key != "case"})
            begin = perf_counter()
            trained = _train(crops, forest, subjects, config, settings)
            seconds[variant["case"]] += perf_counter() - begin
            found[variant["case"]].append(_regress(trained, frames, subjects, config, settings))
    true_points = np.concatenate(truth)
    measured, curves = [], {}
    distances = np.linspace(0.0, _LIMIT_MM, 241)
    for case, parts in found.items():
        points = np.concatenate(parts)  # (n, modes, 21, 3)
        for modes in data["modes"]:
            best = _best_of(points[:, :modes], true_points)
            measured.append({
                "case": f"{case}, {modes} mode{'s' * (modes > 1)}", "tracker": "regressor",
                **summarize(best, true_points).to_dict(), "modes": modes,
                "training_seconds": seconds[case],
            })  # fmt: skip
            errors = keypoint_errors(best, true_points)
            if modes == min(data["modes"]):
                curves[case] = distances, 100.0 * success_curve(errors, distances)
            if case == data["variants"][0]["case"] and modes > min(data["modes"]):
                curves[f"the same, best of {modes} modes"] = (
                    distances, 100.0 * success_curve(errors, distances)
                )  # fmt: skip
    return SuiteResult(
        suite="regression",
        cases=measured,
        curves=[Curves(
            name="regression", title="regression: frames whose worst keypoint is within a distance",
            xlabel="distance [mm]", ylabel="share of frames [%]", lines=curves,
            y_range=(0.0, 100.0),
        )],
        notes=[
            f"{folds} folds over {config.subjects} subjects, {len(config) * (folds - 1) // folds} "
            f"frames to learn from, {len(true_points)} measured; shapes known; nothing refined"
        ],
    )  # fmt: skip


def _best_of(points: Float, truth: Float) -> Float:
    """The mode nearest to the truth in each frame, shape (n, 21, 3)."""
    errors = np.linalg.norm(points - truth[:, None], axis=-1).mean(axis=-1)
    return points[np.arange(len(points)), errors.argmin(axis=1)]


def _test_frames(
    dataset: SyntheticDataset, subjects: NDArray[np.bool_], count: int, settings: SuiteSettings
) -> _Frames:
    """Frames of some subjects, spread over them."""
    each = dataset.config.poses * dataset.config.viewpoints
    samples = np.flatnonzero(np.repeat(subjects, each))
    samples = samples[np.linspace(0, len(samples) - 1, min(count, len(samples))).astype(int)]
    batch = dataset.render(samples.tolist())
    rng = np.random.default_rng([settings.seed, 5])
    truth = batch.keypoints.astype(np.float64)
    return _Frames(
        depth=batch.depth, truth=truth, subjects=batch.subject,
        centres=truth.mean(axis=1) + rng.normal(0.0, 0.02, (len(truth), 3)),
    )  # fmt: skip


def _crops(
    dataset: SyntheticDataset, subjects: NDArray[np.bool_], settings: SuiteSettings, text: str
) -> TrainingCrops:
    """What forests learn from: the frames of some subjects."""
    config = dataset.config
    each = config.poses * config.viewpoints
    device = resolve_device(settings.device)
    # Crops are of one size whatever the forest.
    cropper = Cropper(config.camera, ForestConfig(), _BATCH, device=device)
    samples = np.flatnonzero(np.repeat(subjects, each))
    parts = []
    batches = range(0, len(samples), _BATCH)
    for first in settings.progress(batches, len(batches), text):
        batch = dataset.render(samples[first : first + _BATCH].tolist())
        parts.append(crops_of(cropper, batch.depth, batch.keypoints, batch.poses, batch.subject))
    return join_crops(parts)


def _train(
    crops: TrainingCrops,
    forest: ForestConfig,
    hands: list[ShapedHand],
    config: DatasetConfig,
    settings: SuiteSettings,
) -> Forest:
    """A forest learnt from crops."""
    training = TrainingConfig(forest=forest, dataset=config, mean_share=0.0, seed=settings.seed)
    with TemporaryDirectory() as work:
        return ForestTrainer(
            training, crops, hands, Path(work), device=settings.device, threads=2
        ).run()


def _regress(
    forest: Forest,
    frames: _Frames,
    hands: list[ShapedHand],
    config: DatasetConfig,
    settings: SuiteSettings,
) -> Float:
    """Keypoints of every mode [m], shape (n, modes, 21, 3), the heaviest mode first."""
    found = np.empty((len(frames.depth), forest.config.modes, 21, 3))
    for subject in np.unique(frames.subjects):
        hand = hands[subject]
        cascade = Cascade(forest, [hand], config.camera, device=settings.device)
        for row in np.flatnonzero(frames.subjects == subject):
            cascade.load(frames.depth[row], frames.centres[row])
            palms, _ = cascade.run_palms()
            found[row] = keypoints(hand, cascade.run_fingers(palms)[0])
    return found
