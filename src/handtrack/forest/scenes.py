"""Scenes in which regions are right or wrong: what tells a hand from elbows, heads and cups.

Regions are proposed as in tracking (`camera.segmentation`), and each becomes a crop that is
labelled by whether the hand is in its middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from handtrack.camera.segmentation import centres_of, find_hand_regions, wrists_of
from handtrack.device import resolve_device
from handtrack.forest.config import ForestConfig
from handtrack.forest.crops import (
    SHARD_FRAMES,
    Cropper,
    encode_cells,
    load_shards,
    prepare_shards,
    shard_file,
    write_shard,
)
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.people import Person
from handtrack.synthesis.scenery import DepthScene, nearest
from handtrack.synthesis.things import MeshRenderer, cup_mesh
from handtrack.synthesis.viewpoints import random_rotation

RIGHT, WRONG = 0.08, 0.13
"""Regions nearer than the first to the hand's middle are right, beyond the second wrong [m]."""

MAX_REGIONS = 5
"""Regions proposed per scene."""

_KINDS = (0.45, 0.3, 0.1, 0.15)
"""Shares of scenes with an arm alone, a person who raises the hand, one who does not, a thing."""

_UPPER_ARM = 0.29
"""Shoulder to elbow [m]."""

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionCrops:
    """Crops of regions."""

    cells: NDArray[np.uint16]
    """As in `TrainingCrops`, shape (n, cells, cells)."""
    cameras: NDArray[np.float32]
    """fx, fy, cx, cy of each crop's grid [cells], shape (n, 4)."""
    centres: NDArray[np.float32]
    """Centre of each region [m], camera frame, shape (n, 3)."""
    wrists: NDArray[np.float32]
    """Where each region joins an arm [m], NaN where it stands alone, shape (n, 3)."""
    is_hand: NDArray[np.bool_]
    """Whether the hand is there, shape (n,)."""
    frames: NDArray[np.int32]
    """Scene that each region is from, shape (n,)."""

    def __len__(self) -> int:
        return len(self.cells)

    @classmethod
    def none(cls, cells: int) -> RegionCrops:
        """No crop, of so many cells along each side."""
        return cls(
            cells=np.empty((0, cells, cells), np.uint16), cameras=np.empty((0, 4), np.float32),
            centres=np.empty((0, 3), np.float32), wrists=np.empty((0, 3), np.float32),
            is_hand=np.empty(0, np.bool_), frames=np.empty(0, np.int32),
        )  # fmt: skip


def prepare_regions(dataset: DatasetConfig, forest: ForestConfig, folder: Path, *, jobs: int = 1):
    """Make scenes around the hands of a data set and keep the crops of their regions.

    Arguments, what is yielded and what is raised are as for `prepare_crops`.
    """
    facts = {
        "fingerprint": SyntheticDataset(dataset, device="cpu").fingerprint, "kinds": list(_KINDS),
        "crop_cells": forest.crop_cells, "crop_span": forest.crop_span,
        "dataset": asdict(dataset),
    }  # fmt: skip
    write = partial(_write_shard, dataset, forest, folder)
    yield from prepare_shards(folder, facts, len(dataset), write, jobs=jobs)


def load_regions(folder: Path) -> RegionCrops:
    """All crops that `prepare_regions` made; see `load_shards`."""
    return load_shards(folder, RegionCrops)


def _write_shard(dataset: DatasetConfig, forest: ForestConfig, folder: Path, start: int) -> None:
    """Make the scenes of one file."""
    made = SyntheticDataset(dataset, device="cpu")
    maker = SceneMaker(made)
    cropper = Cropper(dataset.camera, forest, MAX_REGIONS, device=resolve_device("cpu"))
    none = RegionCrops.none(forest.crop_cells)
    parts = {field.name: [getattr(none, field.name)] for field in fields(RegionCrops)}
    for number in range(start, min(start + SHARD_FRAMES, len(dataset))):
        depth, middle = maker.scene(number)
        regions = find_hand_regions(depth, dataset.camera, max_regions=MAX_REGIONS)
        centres = centres_of(regions)
        away = np.linalg.norm(centres - middle, axis=1) if middle is not None else np.full(
            len(centres), np.inf
        )  # fmt: skip
        clear = (away < RIGHT) | (away > WRONG)
        if not clear.any():
            continue
        count = int(clear.sum())
        cells, cameras = cropper.cut(np.broadcast_to(depth, (count, *depth.shape)), centres[clear])
        for name, values in (
            ("cells", encode_cells(cells)), ("cameras", cameras),
            ("centres", centres[clear].astype(np.float32)),
            ("wrists", wrists_of(regions)[clear].astype(np.float32)),
            ("is_hand", away[clear] < RIGHT),
            ("frames", np.full(count, number, np.int32)),
        ):  # fmt: skip
            parts[name].append(values)
    write_shard(
        shard_file(folder, start),
        RegionCrops(**{name: np.concatenate(values) for name, values in parts.items()}),
    )


class SceneMaker:
    """Draws scenes with and without the hands of a data set."""

    def __init__(
        self, dataset: SyntheticDataset, *, cups: Sequence[trimesh.Trimesh] | None = None
    ) -> None:
        """Prepare.

        Args:
            dataset: Hands with their forearms; scene i shows sample i, or none.
            cups: Cups that may stand in a scene; one usual cup when None.
        """
        self._dataset, self._camera = dataset, dataset.config.camera
        self._cups = [
            MeshRenderer(mesh, self._camera, device="cpu") for mesh in (cups or [cup_mesh()])
        ]
        self._scene = DepthScene(self._camera)

    def scene(self, number: int) -> tuple[NDArray[np.float32], Float | None]:
        """One scene.

        Args:
            number: Its number, which decides everything.

        Returns:
            Depth with noise [m], shape (height, width), and the middle of the hand [m], camera
            frame, shape (3,), None without one.
        """
        rng = np.random.default_rng([self._dataset.config.seed, 77, number])
        kind = int(rng.choice(len(_KINDS), p=_KINDS))
        self._scene.clear()
        depth, middle = None, None
        if kind < 2:
            batch = self._dataset.render([number])
            depth = batch.depth[0]
            middle = batch.keypoints[0].astype(np.float64).mean(axis=0)
            if kind == 0:
                return depth, middle
            self._add_owner(batch.elbows[0].astype(np.float64), rng)
        elif kind == 2:
            self._add_bystander(rng)
        else:
            self._add_thing(rng)
            if rng.random() < 0.4:
                self._add_bystander(rng)
        if rng.random() < 0.4:
            self._scene.add_plane(np.array([0.0, 0.0, rng.uniform(1.4, 3.0)]), _AHEAD)
        names = self._dataset.config.noises
        noise = noise_preset(names[int(rng.integers(len(names)))])
        around = noise.apply(self._scene.depth, self._camera, rng)
        return (around if depth is None else nearest(depth, around)), middle

    def _add_owner(self, elbow: Float, rng: np.random.Generator) -> None:
        """The person whose arm it is, behind and beside the elbow."""
        away = rng.normal(0.0, 1.0, 3) * [0.5, 0.35, 0.3] + [-0.3, -0.35, 0.8]
        shoulder = elbow + _UPPER_ARM * away / np.linalg.norm(away)
        turn = rng.uniform(-0.7, 0.7)
        # The right shoulder lies at -x of the chest.
        across = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        chest = shoulder + 0.185 * across - [0.0, 0.04, 0.0]
        person = Person(chest=tuple(chest), turn=turn, arms=_arms(rng))
        person.add_to(self._scene, right_elbow=elbow)

    def _add_bystander(self, rng: np.random.Generator) -> None:
        """A person whose hands are not raised."""
        z = rng.uniform(0.5, 1.6)
        chest = (rng.uniform(-0.5, 0.5) * z, rng.uniform(-0.3, 0.5) * z, z)
        size = rng.uniform(0.8, 1.1)
        Person(chest=chest, turn=rng.uniform(-1.2, 1.2), size=size, arms=_arms(rng)).add_to(
            self._scene
        )

    def _add_thing(self, rng: np.random.Generator) -> None:
        """Something of a hand's size, sometimes at the end of an arm."""
        z = rng.uniform(0.25, 0.9)
        place = np.array([rng.uniform(-0.35, 0.35) * z, rng.uniform(-0.25, 0.25) * z, z])
        rotation = random_rotation(rng)
        shape = rng.integers(4)
        if shape == 0:
            # A single cup draws no number.
            cup = self._cups[int(rng.integers(len(self._cups))) if len(self._cups) > 1 else 0]
            self._scene.add_image(cup.render(rotation, place))
        elif shape == 1:
            self._scene.add_ellipsoid(place, rotation, rng.uniform(0.025, 0.08, 3))
        elif shape == 2:
            self._scene.add_box(place, rotation, rng.uniform(0.015, 0.08, 3))
        else:
            half = rng.uniform(0.03, 0.1) * rotation[:, 0]
            self._scene.add_capsule(place - half, place + half, rng.uniform(0.01, 0.045))
        if rng.random() < 0.4:
            way = rng.normal(size=3) + np.array([0.0, 0.6, 0.8])
            way /= np.linalg.norm(way)
            self._scene.add_capsule(place + 0.05 * way, place + 0.35 * way, 0.035)


_AHEAD = np.array([0.0, 0.0, 1.0])


def _arms(rng: np.random.Generator):
    return "hanging" if rng.random() < 0.5 else "akimbo"
