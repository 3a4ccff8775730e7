"""`handtrack train-forest`: train the regressor that finds hands without a first pose."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainForestOptions:
    """Train a forest on synthesised frames; a run that was interrupted is gone on with.

    Frames are rendered first, then trees are grown stage by stage. Both are kept in the work
    folder, file by file, so the same command again continues where it stopped.

    Examples::

        handtrack train-forest --preset small --work out/forest --out forest.npz
        handtrack train-forest --preset medium --jobs 2 --work out/forest --out models/forest.npz
        handtrack train-forest --features pose-indexed --work out/forest --out pose_indexed.npz
    """

    out: Path
    """Where to write the forest, FILE.npz."""
    work: Path = Path("out/forest")
    """Folder of rendered crops and grown trees; crops serve any forest of the same preset."""
    preset: Literal["small", "medium", "large", "paper"] = "small"
    """small (1,000 frames, minutes), medium (48,000), large (120,000) or paper (320,000 frames)."""
    features: Literal["shape-indexed", "pose-indexed"] = "shape-indexed"
    """Reference points on mesh vertices (Eq. II.15), or on frame origins (Eq. II.14)."""
    structure: Literal["hierarchical", "holistic"] = "hierarchical"
    """Palm and then fingers, or the whole hand at once."""
    jobs: int = 1
    """Processes that render, and trees grown at a time."""
    device: str = "auto"
    """auto, cpu or cuda:0, for growing trees."""
    seed: int = 0
    """Seed of frames, features and bags."""


def run(options: TrainForestOptions) -> int:
    """Render what is missing, grow what is missing, write the forest.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: An option is unusable, or the work folder holds something else.
    """
    from rich.console import Console

    from handtrack.cli import compute_device
    from handtrack.cli.progress import counting
    from handtrack.errors import InputError
    from handtrack.evaluation.report import versions
    from handtrack.forest.config import PRESETS
    from handtrack.forest.crops import load_crops, prepare_crops
    from handtrack.forest.scenes import load_regions, prepare_regions
    from handtrack.forest.training import ForestTrainer
    from handtrack.synthesis.dataset import SyntheticDataset

    if options.jobs < 1:
        raise InputError(f"--jobs is {options.jobs}: expected 1 or more")
    if options.out.suffix != ".npz" or not options.out.resolve().parent.is_dir():
        raise InputError(f"--out is {options.out}: expected FILE.npz in a folder that exists")
    device = compute_device(options.device)
    preset = PRESETS[options.preset]
    config = replace(
        preset,
        dataset=replace(preset.dataset, seed=options.seed),
        scenes=replace(preset.scenes, seed=1000 + options.seed),
        forest=replace(preset.forest, features=options.features, structure=options.structure),
        seed=options.seed,
    )
    folder = options.work / "crops"
    with counting(len(config.dataset), "rendering") as count:
        for done, _ in prepare_crops(config.dataset, config.forest, folder, jobs=options.jobs):
            count(done, "rendering")
    scenes = options.work / "scenes"
    with counting(len(config.scenes), "scenes") as count:
        for done, _ in prepare_regions(config.scenes, config.forest, scenes, jobs=options.jobs):
            count(done, "scenes")
    crops, regions = load_crops(folder), load_regions(scenes)
    dataset = SyntheticDataset(config.dataset, device=device.alias)
    begin = time.perf_counter()
    trainer = ForestTrainer(
        config, crops, dataset.subjects(), options.work / "trees", regions=regions,
        device=device.alias, threads=options.jobs,
    )  # fmt: skip
    with counting(trainer.tree_count, "growing trees") as count:
        forest = trainer.run(count)
    seconds = time.perf_counter() - begin
    command = (
        f"handtrack train-forest --preset {options.preset} --features {options.features} "
        f"--structure {options.structure} --seed {options.seed}"
    )
    facts = {
        "command": command, "frames": len(crops), "growing_seconds": round(seconds, 1),
        "versions": versions(), "licence": "Apache-2.0",
        "source": f"frames synthesised by handtrack, data set {dataset.fingerprint}",
    }  # fmt: skip
    replace(forest, facts=facts).save(options.out)
    Console(stderr=True, soft_wrap=True, highlight=False).print(
        f"{options.out}: {trainer.tree_count} trees from {len(crops)} frames, "
        f"{options.out.stat().st_size / 1e6:.1f} MB"
    )
    return 0
