"""Synthetic data on disk: numbered .npz files that can be made in parts and read one by one.

Each shard is also a recording that `handtrack.open_sequence` reads. Layout: docs/formats.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from handtrack.camera.readers.npz import FORMAT_VERSION
from handtrack.errors import DamagedFileError, InputError
from handtrack.files import UNREADABLE, whole_file
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset

DEPTH_UNIT = 0.0001
"""Step of the stored depth [m]; 65535 of them reach beyond all that is rendered."""

SHARD_SAMPLES = 500
"""Samples per file; a shard is held in memory while it is made, 77 MB at 320x240."""

CONFIG_NAME = "dataset.json"


def shard_path(folder: Path, number: int) -> Path:
    """File of a shard."""
    return folder / f"shard-{number:05d}.npz"


def write_shards(dataset: SyntheticDataset, folder: Path, *, size: int = 32) -> Iterator[int]:
    """Write a data set, going on where an earlier run stopped.

    Files are replaced as a whole, so a shard that is there and readable is complete.

    Args:
        dataset: What to write.
        folder: Where to; made if it does not exist.
        size: Samples rendered at a time.

    Yields:
        How many samples are done, after every batch and after every shard found complete.

    Raises:
        InputError: The folder holds data of another configuration, or other things.
    """
    fingerprint = dataset.fingerprint
    _claim(folder, dataset.config, fingerprint)
    for number, start in enumerate(range(0, len(dataset), SHARD_SAMPLES)):
        stop = min(start + SHARD_SAMPLES, len(dataset))
        path = shard_path(folder, number)
        if _is_complete(path, fingerprint, start, stop):
            yield stop
            continue
        arrays: dict[str, list[np.ndarray]] = {}
        for batch in dataset.batches(start, stop, size=size):
            steps = np.rint(batch.depth.astype(np.float64) / DEPTH_UNIT)
            shapes = [dataset.shape(int(subject)) for subject in batch.subject]
            for name, value in (
                ("sample", batch.indices), ("depth", steps.clip(0, 65535).astype(np.uint16)),
                ("truth_pose", batch.poses), ("truth_keypoints", batch.keypoints),
                ("subject", batch.subject), ("named_pose", batch.named_pose),
                ("noise", batch.noise), ("hidden", batch.hidden), ("body", batch.body),
                ("subject_alpha", np.array([shape.alpha for shape in shapes])),
                ("subject_beta", np.array([shape.beta for shape in shapes])),
            ):  # fmt: skip
                arrays.setdefault(name, []).append(value)
            yield int(batch.indices[-1]) + 1
        _write(
            path,
            dataset,
            fingerprint,
            {name: np.concatenate(parts) for name, parts in arrays.items()},
        )


def _claim(folder: Path, config: DatasetConfig, fingerprint: str) -> None:
    """Write the configuration into a new folder, or compare it with the one that is there."""
    told = folder / CONFIG_NAME
    if told.is_file():
        try:
            found = json.loads(told.read_text(encoding="utf-8"))["fingerprint"]
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedFileError(f"{told} does not describe a data set: {error!r}") from error
        if found != fingerprint:
            raise InputError(
                f"{folder} holds data of another configuration (see {told.name}): choose another "
                "folder, or the settings with which it was begun"
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} exists and is not an empty folder: choose another one")
    folder.mkdir(parents=True, exist_ok=True)
    facts = {"fingerprint": fingerprint, "samples": len(config), **asdict(config)}
    with whole_file(told) as file:
        file.write((json.dumps(facts, indent=1) + "\n").encode("utf-8"))


def _is_complete(path: Path, fingerprint: str, start: int, stop: int) -> bool:
    """Whether a shard needs no making."""
    if not path.is_file():
        return False
    try:
        with np.load(path, allow_pickle=False) as data:
            samples = data["sample"]
            return str(data["fingerprint"]) == fingerprint and np.array_equal(
                samples, np.arange(start, stop)
            )
    except UNREADABLE:
        return False


def _write(
    path: Path, dataset: SyntheticDataset, fingerprint: str, arrays: dict[str, np.ndarray]
) -> None:
    """Write a shard, replaced as a whole."""
    config = dataset.config
    content: dict[str, Any] = {
        "format_version": FORMAT_VERSION, "fingerprint": fingerprint,
        "depth_unit_m": DEPTH_UNIT, "side": config.side,
        "camera": np.array(list(config.camera.to_dict().values()), np.float64),
        "pose_names": np.array(dataset.pose_names), "noise_names": np.array(config.noises),
        "source": f"synthesised by handtrack, data set {fingerprint}", "licence": "Apache-2.0",
        **arrays,
    }  # fmt: skip
    with whole_file(path) as file:
        np.savez_compressed(file, **content)
