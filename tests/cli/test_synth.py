"""`handtrack synth`: sequences and data sets that open again with their truth, and refusals."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.source import open_sequence
from handtrack.cli import main
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.synthesis import shards
from handtrack.synthesis.dataset import DATASETS, DatasetConfig, SyntheticDataset

BASE = ["synth", "recorded_hand_motion", "--frames", "817:829", "--stride", "4", "--device", "cpu"]


def test_a_file_opens_with_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "s.npz"
    assert main([*BASE, "--out", str(out), "--subject", "5", "--side", "left"]) == 0
    assert "3 frames of 320x240" in capsys.readouterr().err
    with open_sequence(out) as sequence:
        assert sequence.truth == {"pose", "keypoints"}
        subject = sequence.subject
        assert subject is not None and subject.side == "left" and subject.alpha is not None
        assert subject.beta is not None
        hand = HandModel.load().shaped(
            HandShape(alpha=subject.alpha, beta=subject.beta), side="left"
        )
        frames = list(sequence)
    assert len(frames) == 3
    for frame in frames:
        assert frame.problem is None and (frame.depth > 0).mean() > 0.03
        assert frame.truth is not None and frame.truth.pose is not None
        np.testing.assert_allclose(
            keypoints(hand, frame.truth.pose), frame.truth.keypoints, atol=1e-5
        )
    assert np.diff([frame.time for frame in frames]) == pytest.approx(4 / 30)


def test_a_folder_holds_the_same_as_a_file(tmp_path: Path) -> None:
    options = [*BASE, "--camera", "realsense", "--noise", "coded-light", "--seed", "3"]
    assert main([*options, "--out", str(tmp_path / "s.npz")]) == 0
    assert main([*options, "--out", str(tmp_path / "folder")]) == 0
    with open_sequence(tmp_path / "s.npz") as one, open_sequence(tmp_path / "folder") as other:
        assert one.camera == other.camera and one.camera.width == 640
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a.depth, b.depth, atol=1e-6)
            assert a.time == pytest.approx(b.time)
    with np.load(tmp_path / "folder" / "truth.npz", allow_pickle=False) as truth:
        assert truth["truth_keypoints"].shape == (3, 21, 3)
    facts = json.loads((tmp_path / "folder" / "camera.json").read_text())
    assert "recorded_hand_motion" in facts["source"] and facts["licence"] == "Apache-2.0"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "s.npz"], "nothing unfinished"


def test_options_change_what_they_should(tmp_path: Path) -> None:
    def images(name: str, *more: str) -> np.ndarray:
        assert main([*BASE, "--out", str(tmp_path / name), *more]) == 0
        with open_sequence(tmp_path / name) as sequence:
            return np.stack([frame.depth for frame in sequence])

    clean = images("clean.npz", "--noise", "none")
    bare = images("bare.npz", "--noise", "none", "--bare")
    noisy = images("noisy.npz")
    assert (bare > 0).sum() < 0.85 * (clean > 0).sum()
    both = (clean > 0) & (noisy > 0)
    assert 1e-4 < np.abs(clean - noisy)[both].mean() < 0.01
    again = images("again.npz")
    np.testing.assert_array_equal(noisy, again)


def test_a_camera_and_a_shape_can_be_files(tmp_path: Path) -> None:
    camera = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
    (tmp_path / "camera.json").write_text(json.dumps({"camera": camera}))
    HandShape(alpha=np.array([1.0, -1.0]), scale=1.1).save(tmp_path / "shape.npz")
    options = [*BASE, "--camera", str(tmp_path / "camera.json"), "--out", str(tmp_path / "s.npz")]
    assert main([*options, "--subject", str(tmp_path / "shape.npz")]) == 0
    with open_sequence(tmp_path / "s.npz") as sequence:
        assert sequence.camera.to_dict() == camera
        assert sequence.subject is not None and sequence.subject.scale == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--camera", "webcam"], "creative, realsense, primesense"),
        (["--camera", "none.json"], "none.json does not exist"),
        (["--subject", "tall"], "mean, a whole number"),
        (["--subject", "nobody.npz"], "nobody.npz"),
        (["--frames", "5"], "expected A:B"),
        (["--frames", "9000:"], "it has 1498 frames"),
        (["--stride", "0"], "stride is 0"),
        (["--device", "tpu"], "device 'tpu'"),
        (["--out", "s.txt"], "FILE.npz, or a folder"),
    ],
)
def test_bad_usage_is_one_line_and_exit_code_2(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*BASE, "--out", "s.npz", *change]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.count("\n") == 1 and not printed.out
    assert not list(tmp_path.iterdir())


def test_a_folder_with_content_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main([*BASE, "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert main(["synth", "no_motion", "--out", str(tmp_path / "s.npz")]) == 2
    assert "leap_hand_motion" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_help_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["synth", "--help"]) == 0
    assert "handtrack synth recorded_hand_motion --out fist.npz" in capsys.readouterr().out


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> DatasetConfig:
    """A data set of two and a half shards in place of the small one."""
    config = DatasetConfig(subjects=2, poses=5, viewpoints=2)
    monkeypatch.setitem(DATASETS, "small", config)
    monkeypatch.setattr(shards, "SHARD_SAMPLES", 8)
    return config


def dataset_options(folder: Path, camera: Path, *more: str) -> list[str]:
    """Words of a command that writes a data set for a small camera."""
    facts = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
    camera.write_text(json.dumps(facts))
    words = ["synth", "--dataset", str(folder), "--camera", str(camera), "--device", "cpu"]
    return [*words, *more]


def test_a_dataset_is_written_in_shards_that_open_as_recordings(
    tmp_path: Path, tiny: DatasetConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    assert main(dataset_options(folder, tmp_path / "camera.json", "--seed", "3")) == 0
    assert "20 samples of 64x48" in capsys.readouterr().err
    names = ["dataset.json", "shard-00000.npz", "shard-00001.npz", "shard-00002.npz"]
    assert sorted(p.name for p in folder.iterdir()) == names
    facts = json.loads((folder / "dataset.json").read_text())
    assert facts["samples"] == 20 and facts["seed"] == 3 and facts["camera"]["width"] == 64
    with np.load(folder / "shard-00001.npz", allow_pickle=False) as shard:
        np.testing.assert_array_equal(shard["sample"], np.arange(8, 16))
        assert shard["depth"].dtype == np.uint16 and shard["depth"].shape == (8, 48, 64)
        assert shard["subject"].tolist() == [0, 0, *[1] * 6]
        shape = HandShape(alpha=shard["subject_alpha"][-1], beta=shard["subject_beta"][-1])
        hand = HandModel.load().shaped(shape)
        np.testing.assert_allclose(
            keypoints(hand, shard["truth_pose"][-1]), shard["truth_keypoints"][-1], atol=1e-6
        )
        assert set(shard["noise"]) <= {0, 1, 2} and len(shard["noise_names"]) == 3
        first = shard["depth"][0] * float(shard["depth_unit_m"])
        config = SyntheticDataset(
            replace(tiny, seed=3, camera=Camera.from_dict(facts["camera"])), device="cpu"
        )
        np.testing.assert_allclose(first, config.render([8]).depth[0], atol=6e-5)
    with open_sequence(folder / "shard-00002.npz") as sequence:
        frames = list(sequence)
    assert len(frames) == 4
    assert all(frame.truth is not None and frame.truth.pose is not None for frame in frames)


def test_a_dataset_is_gone_on_with(
    tmp_path: Path, tiny: DatasetConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, camera = tmp_path / "set", tmp_path / "camera.json"
    words = dataset_options(folder, camera, "--noise", "none")
    assert main(words) == 0
    before = {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.glob("shard*")}
    (folder / "shard-00000.npz").unlink()
    damaged = folder / "shard-00002.npz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    assert main(words) == 0
    kept = folder / "shard-00001.npz"
    assert kept.stat().st_mtime_ns == before[kept.name][0], "complete shards are left alone"
    for path in folder.glob("shard*"):
        with np.load(path) as new, np.load(io.BytesIO(before[path.name][1])) as old:
            for name in old.files:
                np.testing.assert_array_equal(new[name], old[name])
    assert main([*words, "--seed", "1"]) == 2
    assert "another configuration" in capsys.readouterr().err


def test_dataset_usage_is_checked(
    tmp_path: Path, tiny: DatasetConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for words, message in (
        (dataset_options(tmp_path / "mine", tmp_path / "c.json"), "not an empty folder"),
        (dataset_options(tmp_path / "s", tmp_path / "c.json", "--out", "x"), "without MOTION"),
        (["synth", "recorded_hand_motion"], "expected MOTION and --out"),
        (["synth", "--out", "x.npz"], "expected MOTION and --out"),
    ):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert not (tmp_path / "s").exists()
