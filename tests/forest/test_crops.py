"""Training crops: what they show, how they are kept, and how their making is gone on with."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.device import resolve_device
from handtrack.errors import DamagedFileError, InputError
from handtrack.forest import crops as crops_module
from handtrack.forest.config import ForestConfig
from handtrack.forest.crops import (
    DEPTH_UNIT,
    UNKNOWN,
    Cropper,
    TrainingCrops,
    crops_of,
    encode_cells,
    load_crops,
    prepare_crops,
)
from handtrack.forest.row_chunks import CHUNK_FRAMES, CropSource
from handtrack.forest.rows import ForestHands
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset

HALF_STEP = 0.51 * DEPTH_UNIT
"""Rounding to a step, and a little for float32 [m]."""

SMALL = DatasetConfig(subjects=1, poses=2, viewpoints=5, noises=("none",), body_share=0.0)
"""Ten frames."""

FOREST = ForestConfig(crop_cells=32)


def make(
    folder: Path, dataset: DatasetConfig = SMALL, forest: ForestConfig = FOREST, jobs: int = 1
):
    return list(prepare_crops(dataset, forest, folder, jobs=jobs))


@pytest.fixture
def short_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four frames per file."""
    monkeypatch.setattr(crops_module, "SHARD_FRAMES", 4)


def source_of(crops: TrainingCrops, frames) -> CropSource:
    device = resolve_device("cpu")
    count = len(crops)
    return CropSource(
        cells=crops.cells, cameras=crops.cameras, worn=crops.subjects,
        gates=np.zeros((count, 4), np.float32),
        hands=ForestHands.upload(frames.subjects, np.arange(3), device),
    )  # fmt: skip


def test_cells_survive_being_stored(frames, rng) -> None:
    cells = rng.uniform(0.15, 6.5, (2, 32, 32)).astype(np.float32)
    cells[0, :4] = 0.0
    cells[0, 4:8] = np.inf
    cells[0, 8] = np.nan
    stored = encode_cells(cells)
    assert stored.dtype == np.uint16
    np.testing.assert_array_equal(stored[0, :4], 0)
    np.testing.assert_array_equal(stored[0, 4:9], UNKNOWN)
    crops = TrainingCrops(
        cells=stored, cameras=rng.random((2, 4)).astype(np.float32),
        poses=np.zeros((2, 28), np.float32), subjects=np.array([1, 0], np.int32),
    )  # fmt: skip
    source = source_of(crops, frames)
    images = source.images()
    source.load(images, np.array([1, 0]))
    read = images.cells.numpy()
    assert len(read) == CHUNK_FRAMES
    known = np.isfinite(cells[::-1])
    np.testing.assert_allclose(read[:2][known], cells[::-1][known], atol=HALF_STEP)
    np.testing.assert_array_equal(read[:2][~known], np.inf)
    np.testing.assert_array_equal(read[2:], 0.0)
    np.testing.assert_array_equal(images.cameras.numpy()[:2], crops.cameras[::-1])
    np.testing.assert_array_equal(images.image_hand.numpy()[:2], [0, 1])


def test_depth_beyond_what_is_stored_stays_far(frames) -> None:
    stored = encode_cells(np.array([[[6.6, 20.0, -0.1]]], np.float32))
    np.testing.assert_array_equal(stored, [[[UNKNOWN - 1, UNKNOWN - 1, 0]]])


def test_crops_show_the_hand(frames) -> None:
    crops, points = frames.crops, frames.batch.keypoints
    size = crops.cells.shape[1]
    # u = fx x / z + cx
    focal, middle = crops.cameras[:, None, :2], crops.cameras[:, None, 2:]
    pixels = np.rint(focal * points[..., :2] / points[..., 2:] + middle).astype(int)
    assert ((pixels >= 0) & (pixels < size)).all(), "all of the hand is inside"
    rows = np.arange(len(crops))[:, None]
    seen = crops.cells[rows, pixels[..., 1], pixels[..., 0]]
    hit = (seen > 0) & (seen < UNKNOWN)
    assert hit.mean() > 0.9
    # Skin lies before the joints, by a finger's or a palm's half thickness or another finger.
    before = (points[..., 2] - seen * DEPTH_UNIT)[hit]
    assert np.quantile(before, 0.02) > -0.003
    assert 0.003 < np.median(before) < 0.02
    np.testing.assert_array_equal(crops.subjects, frames.batch.subject)
    np.testing.assert_allclose(crops.poses, frames.batch.poses, atol=1e-6)


def test_an_image_alone_gives_the_same_crop(frames) -> None:
    camera = SMALL.camera
    device = resolve_device("cpu")
    one, many = (Cropper(camera, FOREST, count, device=device) for count in (1, 5))
    depth, centres = frames.batch.depth[:3], frames.centres[:3]
    cells, cameras = many.cut(depth, centres)
    for k in range(3):
        alone = one.cut(depth[k : k + 1], centres[k : k + 1])
        np.testing.assert_array_equal(alone[0][0], cells[k])
        np.testing.assert_array_equal(alone[1][0], cameras[k])
    batch = frames.batch
    kept = crops_of(many, depth, batch.keypoints[:3], batch.poses[:3], batch.subject[:3])
    np.testing.assert_array_equal(kept.cells, encode_cells(cells))
    np.testing.assert_array_equal(kept.cameras, cameras)


@pytest.mark.usefixtures("short_files")
def test_files_hold_the_data_set_in_its_order(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "crops"
    assert make(folder) == [(0, 10), (4, 10), (8, 10), (10, 10)]
    names = sorted(path.name for path in folder.iterdir())
    assert names == [
        "crops-0000000.npz", "crops-0000004.npz", "crops-0000008.npz", "crops.json"
    ]  # fmt: skip
    crops = load_crops(folder)
    truth = SyntheticDataset(SMALL, device="cpu").render(range(10))
    assert len(crops) == 10
    np.testing.assert_array_equal(crops.poses, truth.poses.astype(np.float32))
    np.testing.assert_array_equal(crops.subjects, truth.subject)
    assert crops.cells.shape == (10, 32, 32) and crops.cells.dtype == np.uint16
    assert json.loads((folder / "crops.json").read_text())["dataset"]["poses"] == 2


@pytest.mark.usefixtures("short_files")
def test_only_missing_and_unfinished_files_are_made_again(tmp_path: Path) -> None:
    make(tmp_path)
    before = load_crops(tmp_path)
    paths = sorted(tmp_path.glob("crops-*.npz"))
    for path in paths:
        os.utime(path, (1.0, 1.0))
    paths[1].unlink()
    paths[2].write_bytes(paths[2].read_bytes()[:1000])
    assert make(tmp_path) == [(4, 10), (8, 10), (10, 10)]
    assert [path.stat().st_mtime == 1.0 for path in paths] == [True, False, False]
    after = load_crops(tmp_path)
    for name in ("cells", "cameras", "poses", "subjects"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert make(tmp_path) == [(10, 10)]


@pytest.mark.parametrize(
    "change", [{"seed": 1}, {"poses": 3}, {"crop_cells": 48}, {"gate_radius": 0.2}]
)
def test_a_folder_of_other_crops_is_left_alone(tmp_path: Path, change: dict) -> None:
    told = prepare_crops(SMALL, FOREST, tmp_path)
    next(told)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    own = "crop_cells" in change or "gate_radius" in change
    dataset, forest = (
        (SMALL, replace(FOREST, **change)) if own else (replace(SMALL, **change), FOREST)
    )
    with pytest.raises(InputError, match=r"another data set.*crops\.json") as caught:
        make(tmp_path, dataset, forest)
    assert str(tmp_path) in str(caught.value)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_left_hands_are_not_learnt(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="right hands"):
        make(tmp_path / "left", replace(SMALL, side="left"))
    assert not (tmp_path / "left").exists()


@pytest.mark.parametrize("damage", ["text", "flipped", "without poses"])
def test_a_damaged_file_is_named(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "crops-0000000.npz"
    arrays = {
        "cells": np.zeros((3, 16, 16), np.uint16), "cameras": np.zeros((3, 4), np.float32),
        "poses": np.zeros((3, 28), np.float32), "subjects": np.zeros(3, np.int32),
    }  # fmt: skip
    if damage == "without poses":
        del arrays["poses"]
    np.savez(path, **arrays)
    data = path.read_bytes()
    if damage == "text":
        path.write_text("cells")
    elif damage == "flipped":
        middle = len(arrays["cells"].tobytes()) // 2
        path.write_bytes(data[:middle] + b"\xff" * 16 + data[middle + 16 :])
    with pytest.raises(DamagedFileError) as caught:
        load_crops(tmp_path)
    assert path.name in str(caught.value)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no crops"):
        load_crops(tmp_path)


@pytest.mark.slow
def test_other_processes_make_the_same(tmp_path: Path) -> None:
    assert make(tmp_path / "two", jobs=2) == [(0, 10), (10, 10)]
    make(tmp_path / "one")
    one, two = (load_crops(tmp_path / name) for name in ("one", "two"))
    np.testing.assert_array_equal(one.cells, two.cells)
    np.testing.assert_array_equal(one.poses, two.poses)
