"""The part of `handtrack synth` that writes data sets for training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from handtrack.cli.synth import SynthOptions

BATCH = 32
"""Samples rendered at a time."""


def write_dataset(options: SynthOptions, folder: Path) -> int:
    """Write the shards of a data set that are not there yet.

    Args:
        options: The command's options.
        folder: Where to.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: An option does not fit, or the folder holds something else.
    """
    from rich.console import Console

    from handtrack.cli import compute_device
    from handtrack.cli.progress import progress
    from handtrack.cli.synth import find_camera
    from handtrack.errors import InputError
    from handtrack.synthesis.dataset import DATASETS, SyntheticDataset
    from handtrack.synthesis.shards import write_shards

    if options.motion is not None or options.out is not None:
        raise InputError(
            "--dataset goes without MOTION and --out: poses are drawn, and it names the folder"
        )
    config = replace(
        DATASETS[options.preset], seed=options.seed, side=options.side,
        camera=find_camera(options.camera),
    )  # fmt: skip
    if options.noise is not None:
        config = replace(config, noises=(options.noise.replace("-", "_"),))
    dataset = SyntheticDataset(config, device=compute_device(options.device).alias, batch=BATCH)
    done = write_shards(dataset, folder, size=BATCH)
    for _ in progress(_one_by_one(done), len(dataset), "rendering"):
        pass
    size = sum(path.stat().st_size for path in folder.glob("shard-*.npz"))
    Console(stderr=True, soft_wrap=True, highlight=False).print(
        f"{folder}: {len(dataset)} samples of {config.camera.width}x{config.camera.height}, "
        f"{size / 1e6:.0f} MB"
    )
    return 0


def _one_by_one(done: Iterator[int]) -> Iterator[int]:
    """Every sample's number once, from running totals, as a progress bar counts them."""
    counted = 0
    for total in done:
        yield from range(counted, total)
        counted = total
