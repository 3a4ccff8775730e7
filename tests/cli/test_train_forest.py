"""`handtrack train-forest`: a forest that loads, going on, and refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from handtrack.cli import main
from handtrack.forest import config as forest_config
from handtrack.forest.artifact import Forest
from handtrack.forest.config import ForestConfig, TrainingConfig
from handtrack.synthesis.dataset import DatasetConfig

TINY = TrainingConfig(
    forest=ForestConfig(
        stages=1,
        trees=2,
        depth=3,
        min_leaf=2,
        points=20,
        candidates=10,
        modes=2,
        crop_cells=32,
        presence_trees=2,
        presence_candidates=10,
    ),
    dataset=DatasetConfig(subjects=1, poses=3, viewpoints=4),
    scenes=DatasetConfig(subjects=1, poses=3, viewpoints=4, seed=1000),
)
"""Twelve frames, twelve scenes, 14 trees."""


@pytest.fixture(autouse=True)
def tiny_preset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(forest_config.PRESETS, "small", TINY)


def train(folder: Path, *words: str, out: str = "forest.npz") -> int:
    return main([
        "train-forest", "--preset", "small", "--device", "cpu", "--work", str(folder / "work"),
        "--out", str(folder / out), *words,
    ])  # fmt: skip


def stamps(folder: Path) -> dict[str, float]:
    return {path.name: path.stat().st_mtime for path in folder.rglob("*.npz")}


def test_a_forest_is_written_and_its_training_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path) == 0
    told = capsys.readouterr()
    assert "14 trees from 12 frames" in told.err and not told.out
    forest = Forest.load(tmp_path / "forest.npz")
    assert len(forest.palm) == len(forest.fingers) == 1 and forest.presence is not None
    assert "train-forest --preset small" in forest.facts["command"]
    assert forest.facts["frames"] == 12 and forest.facts["licence"] == "Apache-2.0"

    # The same again makes nothing but the file, and all that was made before is still there.
    work = tmp_path / "work"
    for path in work.rglob("*.npz"):
        os.utime(path, (1.0, 1.0))
    gone = next(work.rglob("tree-*-palm-0-1.npz"))
    gone.unlink()
    assert train(tmp_path, out="again.npz") == 0
    assert {name for name, stamp in stamps(work).items() if stamp > 2.0} == {gone.name}
    again = Forest.load(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.palm[0].updates, forest.palm[0].updates)
    np.testing.assert_array_equal(again.fingers[0].thresholds, forest.fingers[0].thresholds)

    # Another structure learns from the same frames.
    holistic = ["--structure", "holistic", "--features", "pose-indexed"]
    assert train(tmp_path, *holistic, out="whole.npz") == 0
    whole = Forest.load(tmp_path / "whole.npz")
    assert whole.holistic and (whole.palm[0].anchors == -1).all()
    made = {name for name, stamp in stamps(work).items() if stamp > 2.0}
    assert all(name.startswith("tree-") for name in made)

    # Frames of another seed need another folder.
    capsys.readouterr()
    assert train(tmp_path, "--seed", "1", out="other.npz") == 2
    printed = capsys.readouterr()
    assert "another data set" in printed.err.splitlines()[-1]
    assert not (tmp_path / "other.npz").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "forest.txt"], "FILE.npz"),
        (["--out", "nowhere/forest.npz"], "folder that exists"),
        (["--jobs", "0"], "--jobs is 0"),
        (["--device", "tpu"], "device 'tpu'"),
        (["--preset", "huge"], "huge"),
    ],
)
def test_bad_usage_is_one_line_and_exit_code_2(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train-forest", "--out", "forest.npz", "--work", "work", *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and not printed.out
    if words[0] != "--preset":  # what the words' parser says takes a few lines
        assert printed.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
