"""A tiny forest, the frames that it learnt from, and what it takes to learn another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.device import resolve_device
from handtrack.forest.artifact import Forest, ForestStage
from handtrack.forest.config import ForestConfig, TrainingConfig
from handtrack.forest.crops import DEPTH_UNIT, Cropper, TrainingCrops, crops_of
from handtrack.forest.scenes import RegionCrops
from handtrack.forest.training import ForestTrainer
from handtrack.hand.kinematics import palm_centre
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.synthesis.dataset import DatasetBatch, DatasetConfig, SyntheticDataset

TINY = TrainingConfig(
    forest=ForestConfig(
        stages=2, trees=3, depth=7, min_leaf=2, bag=0.8, points=48, candidates=48, modes=4,
        presence_trees=3, presence_candidates=48,
    ),
    dataset=DatasetConfig(
        subjects=2, poses=12, viewpoints=5, noises=("none",), occluder_share=0.0, body_share=0.0,
        distance=(0.35, 0.5),
    ),
    centre_spread=0.01, forearm_shift=0.03, palm_spread=0.002, palm_turn=0.03,
)  # fmt: skip
"""120 clean frames, 36 trees and a presence; some tenths of a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Rendered frames with their truth, and their crops."""

    batch: DatasetBatch
    crops: TrainingCrops
    subjects: list[ShapedHand]
    left_subjects: list[ShapedHand]

    @property
    def centres(self) -> NDArray[np.float64]:
        """Where the hands are expected [m], shape (n, 3)."""
        return palm_centre(self.batch.keypoints)

    def hands(self, rows: NDArray | slice = slice(None)) -> list[ShapedHand]:
        """Hand of each frame."""
        return [self.subjects[subject] for subject in self.batch.subject[rows]]


@pytest.fixture(scope="session")
def frames() -> Frames:
    """The frames of `TINY`."""
    dataset = SyntheticDataset(TINY.dataset, device="cpu")
    batch = dataset.render(range(len(dataset)))
    cropper = Cropper(TINY.dataset.camera, TINY.forest, len(batch), device=resolve_device("cpu"))
    crops = crops_of(cropper, batch.depth, batch.keypoints, batch.poses, batch.subject)
    model = HandModel.load()
    left = [model.shaped(dataset.shape(s), side="left") for s in range(TINY.dataset.subjects)]
    return Frames(batch=batch, crops=crops, subjects=dataset.subjects(), left_subjects=left)


@pytest.fixture(scope="session")
def regions(frames: Frames) -> RegionCrops:
    """The frames' hands, and walls at their distances."""
    distance = frames.centres[:, 2]
    walls = np.broadcast_to((distance / DEPTH_UNIT)[:, None, None], frames.crops.cells.shape)
    count = len(frames.crops)
    twice = [np.concatenate([values, values]) for values in (
        frames.crops.cameras, frames.centres.astype(np.float32), frames.batch.keypoints[:, 0]
    )]  # fmt: skip
    return RegionCrops(
        cells=np.concatenate([frames.crops.cells, np.rint(walls).astype(np.uint16)]),
        cameras=twice[0], centres=twice[1], wrists=twice[2],
        is_hand=np.repeat([True, False], count), frames=np.arange(2 * count, dtype=np.int32),
    )  # fmt: skip


@pytest.fixture(scope="session")
def train(frames: Frames) -> Callable[..., Forest]:
    """Learn a forest from the frames: `train(work, regions=..., threads=..., report=..., trees=2)`.

    Any setting of the forest and of its training can be given by its name.
    """

    def learn(
        work: Path,
        *,
        regions: RegionCrops | None = None,
        threads: int = 1,
        report: Callable[[int, str], None] = lambda *_: None,
        **changes: object,
    ) -> Forest:
        own = {f.name for f in fields(ForestConfig)}
        forest = replace(TINY.forest, **{k: v for k, v in changes.items() if k in own})
        others = {k: v for k, v in changes.items() if k not in own}
        trainer = ForestTrainer(
            replace(TINY, forest=forest, **others), frames.crops, frames.subjects, work,
            regions=regions, device="cpu", threads=threads,
        )  # fmt: skip
        return trainer.run(report)

    return learn


@dataclass(frozen=True, slots=True, kw_only=True)
class Learnt:
    """A forest and how it came about."""

    forest: Forest
    work: Path
    reports: list[tuple[int, str]]


@pytest.fixture(scope="session")
def tiny(train, regions: RegionCrops, tmp_path_factory: pytest.TempPathFactory) -> Learnt:
    """A forest learnt from the frames and regions; its trees are kept in a folder."""
    work, reports = tmp_path_factory.mktemp("trees"), []
    forest = train(work, regions=regions, report=lambda *told: reports.append(told))
    return Learnt(forest=forest, work=work, reports=reports)


def stages_of(forest: Forest) -> dict[str, ForestStage]:
    """All stages of a forest by a name."""
    named = {f"palm {k}": stage for k, stage in enumerate(forest.palm)}
    named |= {f"fingers {k}": stage for k, stage in enumerate(forest.fingers)}
    return named if forest.presence is None else {**named, "presence": forest.presence}


@pytest.fixture(scope="session")
def assert_same_forest() -> Callable[[Forest, Forest], None]:
    """Compare all arrays of two forests, exactly."""

    def compare(one: Forest, other: Forest) -> None:
        np.testing.assert_array_equal(one.anchor_vertices, other.anchor_vertices)
        stages, others = stages_of(one), stages_of(other)
        assert stages.keys() == others.keys()
        for name, stage in stages.items():
            for field in fields(ForestStage):
                np.testing.assert_array_equal(
                    getattr(stage, field.name), getattr(others[name], field.name),
                    err_msg=f"{name}: {field.name}",
                )  # fmt: skip

    return compare
