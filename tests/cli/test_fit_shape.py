"""`handtrack fit-shape`: files, table and page; unusable options."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from handtrack.cli import main
from handtrack.hand.shape import HandShape


@pytest.mark.slow
def test_the_sample_gives_a_shape_that_track_takes(tmp_path: Path, capsys) -> None:
    out = tmp_path / "me.npz"
    words = ["fit-shape", "data/demo.npz", "--frames", "12", "--device", "cpu"]
    assert main([*words, "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert "bone lengths, mm" in told.out and "depth error, mm" in told.out
    shape = HandShape.load(out)
    assert shape.alpha_std is not None and (shape.problem is None) == ("warning" not in told.err)
    page = cv2.imread(str(tmp_path / "me.png"))
    assert page is not None and page.shape[0] > 300 and np.ptp(page) > 100


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--out", "me.txt"], "expected a .npz file"),
        (["--out", "nowhere/me.npz"], "folder that exists"),
        (["--out", "me.npz", "--frames", "0"], "at least 1"),
    ],
)
def test_unusable_options_are_refused(tmp_path, monkeypatch, capsys, words, wanted) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fit-shape", "nothing.npz", *words]) == 2
    assert wanted in capsys.readouterr().err
