from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro

from handtrack.cli import main
from handtrack.cli.eval import EvalOptions, run
from handtrack.errors import InputError, MissingFileError
from handtrack.evaluation.protocols import NYU


def parse(*arguments: str | Path) -> EvalOptions:
    """Options as the command line gives them."""
    return tyro.cli(EvalOptions, args=[str(argument) for argument in arguments])


@pytest.fixture
def sequence(rng: np.random.Generator, tmp_path: Path) -> Path:
    """A sequence with its truth, and results 4 mm and 25 mm off."""
    truth = rng.normal(size=(6, 21, 3)) * 0.1
    np.savez(tmp_path / "sequence.npz", truth_keypoints=truth)
    np.savez(tmp_path / "good.npz", keypoints=truth + np.array([0.004, 0, 0]))
    np.savez(tmp_path / "bad.npz", keypoints=truth + np.array([0, 0.025, 0]))
    return tmp_path


@pytest.mark.data
@pytest.mark.parametrize(
    ("method", "mean", "within_20"),
    [("DeepPrior", "20.750 mm", "16.27%"), ("V2V-PoseNet", "8.419 mm", "71.24%")],
)
def test_published_numbers_are_printed(
    recordings: Path, capsys: pytest.CaptureFixture[str], method: str, mean: str, within_20: str
) -> None:
    options = parse(recordings / "published" / f"nyu_{method}.txt", "--protocol", "nyu")
    assert run(options) == 0
    printed = capsys.readouterr().out
    assert mean in printed and within_20 in printed
    for threshold in (20, 30, 40):
        assert f"within {threshold} mm" in printed


def test_our_results_are_compared_in_one_table(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = parse(
        sequence / "good.npz",
        sequence / "bad.npz",
        "--truth",
        sequence / "sequence.npz",
        "--joints",
    )
    assert run(options) == 0
    printed = capsys.readouterr().out
    row = next(line for line in printed.splitlines() if "mean joint error" in line)
    assert "4.000 mm" in row and "25.000 mm" in row
    row = next(line for line in printed.splitlines() if "within 20 mm" in line)
    assert "100.00%" in row and "0.00%" in row
    assert "thumb_cmc" in printed and "without prediction" not in printed


def test_json_and_pictures_are_written(sequence: Path) -> None:
    options = parse(
        *(sequence / "good.npz", "--truth", sequence / "sequence.npz"),
        *("--json", sequence / "e.json", "--curve", sequence / "c.png"),
        *("--over-time", sequence / "t.png"),
    )
    assert run(options) == 0
    document = json.loads((sequence / "e.json").read_text())
    assert document["suite"] == "eval"
    (case,) = document["cases"]
    assert case["case"] == "good" and case["frames"] == 6
    assert case["keypoint_error_mm"]["mean"] == pytest.approx(4.0)
    assert case["success_rate"] == {"20": 1.0, "30": 1.0, "40": 1.0}
    assert case["lost_rate"] == 0.0
    for name in ("c.png", "t.png"):
        image = cv2.imread(str(sequence / name))
        assert image is not None and len(np.unique(image.reshape(-1, 3), axis=0)) > 5


def test_results_of_the_same_name_are_told_apart(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = sequence / "other"
    other.mkdir()
    (other / "good.npz").write_bytes((sequence / "bad.npz").read_bytes())
    options = parse(
        *(sequence / "good.npz", other / "good.npz"),
        *("--truth", sequence / "sequence.npz", "--json", sequence / "e.json"),
    )
    assert run(options) == 0
    cases = json.loads((sequence / "e.json").read_text())["cases"]
    assert [case["case"] for case in cases] == [
        str(sequence / "good.npz"),
        str(other / "good.npz"),
    ]


def test_bad_input_is_refused_before_anything_is_written(sequence: Path) -> None:
    good = parse(sequence / "good.npz", "--truth", sequence / "sequence.npz")
    with pytest.raises(InputError, match="at least one file"):
        run(replace(good, files=()))
    with pytest.raises(MissingFileError, match=r"nothing\.npz"):
        run(replace(good, files=(sequence / "nothing.npz",)))
    with pytest.raises(InputError, match="--protocol"):
        run(replace(good, files=(sequence / "x.txt",)))
    with pytest.raises(InputError, match="is no folder"):
        run(replace(good, json=sequence / "none" / "e.json"))
    (sequence / "mine.txt").write_text("1 2 3\n")
    (sequence / NYU.truth_file).write_text("1 2 3\n")
    with pytest.raises(InputError, match="42 numbers"):
        run(parse(sequence / "mine.txt", "--protocol", "nyu"))


def test_help_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse("--help")
    assert caught.value.code == 0
    assert "handtrack eval nyu_DeepPrior.txt --protocol nyu" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        parse("x.txt", "--protocol", "msra")
    assert caught.value.code == 2


def test_command_line_ends_with_the_documented_codes(
    sequence: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = str(sequence / "sequence.npz")
    assert main(["eval", str(sequence / "good.npz"), "--truth", truth]) == 0
    assert "4.000 mm" in capsys.readouterr().out
    assert main(["eval", str(sequence / "nothing.npz"), "--truth", truth]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["eval", "--truth", truth]) == 2
