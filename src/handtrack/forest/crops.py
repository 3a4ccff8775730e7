"""Training frames cut down to what features read: a crop around each hand, in numbered files.

A frame of 320 x 240 takes 154 kB as 16-bit depth, its crop 25 kB, so that the thesis' 320,000
frames stay below 8 GB. Files are made one by one, in parallel, and again only when missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.device import resolve_device
from handtrack.errors import DamagedFileError, InputError
from handtrack.files import UNREADABLE, whole_file
from handtrack.forest.config import ForestConfig
from handtrack.hand.kinematics import palm_centre
from handtrack.kernels.crop import GATE_SIZE, crop_depth, crop_parameters
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset

SHARD_FRAMES = 1000
"""Frames per file."""

DEPTH_UNIT = 0.0001
"""Step of the stored depth [m]."""

UNKNOWN = 65535
"""Stored value of a cell that says nothing; 0 is background."""

GATE_MARGIN = 0.12
"""Stored crops reach so much beyond the ball of a hand, whose place is known only roughly [m]."""

SAME_SURFACE = 0.015
"""Neighbouring pixels closer in depth than this share a surface [m]."""

_BATCH = 50

Arrays = TypeVar("Arrays")
"""A dataclass of arrays with the frames along the first axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingCrops:
    """Crops of labelled frames."""

    cells: NDArray[np.uint16]
    """z in steps of `DEPTH_UNIT`, 0 background, `UNKNOWN`, shape (n, cells, cells)."""
    cameras: NDArray[np.float32]
    """fx, fy, cx, cy of each crop's grid [cells], shape (n, 4)."""
    poses: NDArray[np.float32]
    """True poses, shape (n, 28)."""
    subjects: NDArray[np.int32]
    """Subject of each frame, shape (n,)."""

    def __len__(self) -> int:
        return len(self.cells)


class Cropper:
    """Cuts crops for the forest out of depth images of one camera, a batch at a time."""

    def __init__(
        self, camera: Camera, config: ForestConfig, count: int, *, device: wp.Device
    ) -> None:
        """Allocate.

        Args:
            camera: Camera of all images.
            config: Size of the crops.
            count: Images per batch.
            device: Where the kernels run.
        """
        n = config.crop_cells
        self._config = config
        self._intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        self.depth = wp.zeros((count, camera.height, camera.width), dtype=float, device=device)
        self.intrinsics = wp.array(np.array(self._intrinsics, "f4"), dtype=float, device=device)
        self.crops = wp.zeros((count, 8), dtype=float, device=device)
        self.gates = wp.zeros((count, GATE_SIZE), dtype=float, device=device)
        self.cells = wp.zeros((count, n, n), dtype=float, device=device)
        self.points = wp.zeros((count, n, n), dtype=wp.vec3, device=device)

    def place(self, centres: NDArray) -> None:
        """Lay the crops around expected hands.

        Args:
            centres: Centres [m], camera frame, shape (count, 3).
        """
        crops = crop_parameters(
            self._intrinsics, centres, cells=self._config.crop_cells, span=self._config.crop_span
        )
        self.crops.assign(crops)
        radius = self._config.gate_radius + GATE_MARGIN
        gates = np.column_stack([centres, np.full(len(centres), radius)])
        self.gates.assign(gates.astype(np.float32))

    def launch(self) -> None:
        """Cut the crops of the loaded images."""
        crop_depth(
            self.depth, self.intrinsics, self.crops, self.gates, same_surface=SAME_SURFACE,
            cells=self.cells, points=self.points,
        )  # fmt: skip

    def cut(
        self, depth: NDArray[np.float32], centres: NDArray
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Crops of at most as many images as it was made for.

        Args:
            depth: Depth [m], shape (n, height, width).
            centres: Centres [m], camera frame, shape (n, 3).

        Returns:
            Cells [m], shape (n, cells, cells), and fx, fy, cx, cy of their grids, shape (n, 4).
        """
        count = len(depth)
        padded = np.zeros(self.depth.shape, np.float32)
        padded[:count] = depth
        places = np.tile([0.0, 0.0, 1.0], (len(padded), 1))
        places[:count] = centres
        self.depth.assign(padded)
        self.place(places)
        self.launch()
        cells, crops = self.cells.numpy()[:count], self.crops.numpy()[:count, :4]
        return np.array(cells, np.float32), np.array(crops, np.float32)


def prepare_crops(
    dataset: DatasetConfig, forest: ForestConfig, folder: Path, *, jobs: int = 1
) -> Iterator[tuple[int, int]]:
    """Render a data set and keep its crops, going on where an earlier run stopped.

    Args:
        dataset: What to render.
        forest: Size of the crops.
        folder: Where to keep them; made if it does not exist.
        jobs: Processes that render.

    Yields:
        Frames done, and frames in all.

    Raises:
        InputError: The folder holds crops of another data set.
    """
    if dataset.side != "right":
        raise InputError("forests learn from right hands; left ones are mirrored when tracked")
    facts = {
        "fingerprint": SyntheticDataset(dataset, device="cpu").fingerprint,
        "crop_cells": forest.crop_cells, "crop_span": forest.crop_span,
        "gate_radius": forest.gate_radius, "dataset": asdict(dataset),
    }  # fmt: skip
    write = partial(_write_shard, dataset, forest, folder)
    yield from prepare_shards(folder, facts, len(dataset), write, jobs=jobs)


def prepare_shards(
    folder: Path, facts: dict[str, Any], total: int, write: Callable[[int], object], *, jobs: int
) -> Iterator[tuple[int, int]]:
    """Make the files of a folder that are missing.

    Args:
        folder: Where to keep them; made if it does not exist.
        facts: What the folder holds, for comparing with what it says.
        total: Frames in all.
        write: Makes the file that starts with a frame, at `shard_file`.
        jobs: Processes that do so.

    Yields:
        Frames done, and frames in all.

    Raises:
        InputError: The folder holds something else.
    """
    _claim(folder, facts)
    missing = [
        start for start in range(0, total, SHARD_FRAMES)
        if not _is_complete(shard_file(folder, start))
    ]  # fmt: skip

    def size(start: int) -> int:
        return min(SHARD_FRAMES, total - start)

    done = total - sum(map(size, missing))
    yield done, total
    if jobs == 1:
        for start in missing:
            write(start)
            done += size(start)
            yield done, total
        return
    # Forked processes would share Warp's runtime.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        work = {pool.submit(write, start): start for start in missing}
        for made in as_completed(work):
            made.result()
            done += size(work[made])
            yield done, total


def load_shards(folder: Path, kind: type[Arrays]) -> Arrays:
    """All files of a folder, joined; read into memory.

    Args:
        folder: Where they are.
        kind: Dataclass of arrays whose fields the files hold.

    Raises:
        DamagedFileError: A file cannot be read.
        InputError: There are none.
    """
    paths = sorted(folder.glob("crops-*.npz"))
    if not paths:
        raise InputError(f"{folder} holds no crops: expected crops-*.npz")
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    parts: dict[str, list[NDArray]] = {name: [] for name in names}
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as data:
                for name in names:
                    parts[name].append(data[name])
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} does not hold crops: {error}") from error
    return kind(**{name: np.concatenate(values) for name, values in parts.items()})


def load_crops(folder: Path) -> TrainingCrops:
    """All crops that `prepare_crops` made; see `load_shards`."""
    return load_shards(folder, TrainingCrops)


def shard_file(folder: Path, start: int) -> Path:
    """File that starts with a frame."""
    return folder / f"crops-{start:07d}.npz"


def write_shard(path: Path, arrays: object) -> None:
    """Write a dataclass of arrays; stored, not compressed, for it is read again and again."""
    with whole_file(path) as file:
        np.savez(file, **{f.name: getattr(arrays, f.name) for f in fields(arrays)})  # type: ignore[arg-type]


def _claim(folder: Path, facts: dict[str, Any]) -> None:
    """Say what a folder holds, or compare with what it says."""
    told = folder / "crops.json"
    text = json.dumps(facts, indent=1) + "\n"
    if told.is_file():
        if told.read_text(encoding="utf-8") != text:
            raise InputError(
                f"{folder} holds crops of another data set (see {told.name}): choose another folder"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    with whole_file(told) as file:
        file.write(text.encode("utf-8"))


def _is_complete(path: Path) -> bool:
    """Whether a file is there and readable; files are written as a whole."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return len(data.files) > 0
    except UNREADABLE:
        return False


def _write_shard(dataset: DatasetConfig, forest: ForestConfig, folder: Path, start: int) -> None:
    """Render the frames of one file."""
    made = SyntheticDataset(dataset, device="cpu")
    stop = min(start + SHARD_FRAMES, len(dataset))
    cropper = Cropper(dataset.camera, forest, _BATCH, device=resolve_device("cpu"))
    parts = [
        crops_of(cropper, batch.depth, batch.keypoints, batch.poses, batch.subject)
        for batch in made.batches(start, stop, size=_BATCH)
    ]  # fmt: skip
    write_shard(shard_file(folder, start), join_crops(parts))


def crops_of(
    cropper: Cropper,
    depth: NDArray[np.float32],
    keypoints: NDArray,
    poses: NDArray,
    subjects: NDArray,
) -> TrainingCrops:
    """Crops around the palms of labelled frames.

    Args:
        cropper: Made for at least so many images.
        depth: Depth [m], shape (n, height, width).
        keypoints: True keypoints [m], shape (n, 21, 3).
        poses: True poses, shape (n, 28).
        subjects: Subject of each frame, shape (n,).
    """
    cells, cameras = cropper.cut(depth, palm_centre(keypoints))
    return TrainingCrops(
        cells=encode_cells(cells), cameras=cameras,
        poses=poses.astype(np.float32), subjects=subjects.astype(np.int32),
    )  # fmt: skip


def join_crops(parts: list[TrainingCrops]) -> TrainingCrops:
    """Crops of all parts, in their order."""
    names = [field.name for field in fields(TrainingCrops)]
    return TrainingCrops(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    )


def encode_cells(cells: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Cells [m], infinity where unknown, as 16-bit steps."""
    known = np.isfinite(cells)
    steps = np.rint(np.where(known, cells, 0.0) / DEPTH_UNIT).clip(0, UNKNOWN - 1)
    return np.where(known, steps, UNKNOWN).astype(np.uint16)
