"""`handtrack track`: results on disk, first poses, damaged frames, bad usage."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

import handtrack
from cli.short_runs import interrupt, results, synthesise
from handtrack.artifacts import artifact_path
from handtrack.camera.source import FORMATS, open_sequence
from handtrack.cli import main
from handtrack.cli.track import FormatName
from handtrack.evaluation.run_record import COLUMNS
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import KEYPOINTS, POSE
from handtrack.transforms import quat_to_matrix

COUNT = 8


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthesised recording of a subject, as one file."""
    return synthesise(tmp_path_factory.mktemp("track") / "hand.npz", COUNT, "--subject", "3")


@pytest.fixture(scope="module")
def folder(sequence: Path) -> Path:
    """The same as PNG images, which carry no labels."""
    return synthesise(sequence.parent / "folder", COUNT, "--subject", "3")


@pytest.fixture(scope="module")
def run(sequence: Path) -> Path:
    """Results of a run with a video."""
    out = sequence.parent / "run"
    assert track(sequence, out, "--video") == 0
    return out


def track(source: Path, out: Path, *more: str) -> int:
    return main(["track", str(source), "--out", str(out), "--device", "cpu", *more])


def test_everything_is_written_and_fits_together(sequence: Path, run: Path) -> None:
    names = sorted(path.name for path in run.iterdir())
    assert names == ["config.json", "overlay.mp4", "results.csv", "results.npz"]
    found = results(run)
    assert found["pose"].shape == (COUNT, 28) and found["keypoints"].shape == (COUNT, 21, 3)
    assert found["pose_names"].tolist() == list(POSE)
    assert found["keypoint_names"].tolist() == list(KEYPOINTS)
    assert found["state"].tolist() == ["tracking"] * COUNT
    assert found["frame_index"].tolist() == list(range(COUNT))
    with open_sequence(sequence) as truth:
        np.testing.assert_array_equal(found["truth_keypoints"][0], truth[0].truth.keypoints)  # type: ignore[index]
    error = np.linalg.norm(found["keypoints"] - found["truth_keypoints"], axis=-1)
    assert 1e3 * error.mean() < 8.0
    assert (found["depth_error"] < 0.02).all()
    assert found["keypoint_std"].shape == (COUNT, 21)
    assert (1e3 * found["keypoint_std"] > 0.5).all() and 1e3 * found["keypoint_std"].mean() < 20
    assert "total" in found["timing_names"].tolist() and (found["timings_ms"][:, -1] > 0).all()


def test_the_table_holds_the_same_numbers(run: Path) -> None:
    found = results(run)
    with (run / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS and len(rows) == COUNT
    for place, row in enumerate(rows):
        assert int(row["frame"]) == place and row["state"] == "tracking"
        pose = [float(value) for value in list(row.values())[4:32]]
        np.testing.assert_allclose(pose, found["pose"][place], rtol=1e-6, atol=1e-6)
        tip = [float(row[f"index_tip_{axis}_m"]) for axis in "xyz"]
        np.testing.assert_allclose(tip, found["keypoints"][place, 8], rtol=1e-5)
        sigma = float(row["index_tip_std_m"])
        assert sigma == pytest.approx(found["keypoint_std"][place, 8], rel=1e-5)
        assert float(row["depth_error_m"]) == pytest.approx(found["depth_error"][place], rel=1e-6)
        assert float(row["time_s"]) == pytest.approx(found["time"][place], abs=1e-6)
    assert np.degrees(np.abs(found["pose"][:, 7:])).max() < 150, "angles are in radians"


def test_the_configuration_tells_what_is_needed_to_repeat_it(sequence: Path, run: Path) -> None:
    facts = json.loads((run / "config.json").read_text())
    assert facts["source"] == str(sequence) and facts["format"] == "npz"
    assert facts["tracker"] == "hybrid" and facts["device"] == "cpu" and facts["seed"] == 0
    assert facts["tracker_config"]["fit"]["iterations"] > 0
    assert facts["versions"]["handtrack"] == handtrack.__version__
    assert facts["camera"]["width"] == 320 and facts["frames"] == COUNT
    assert facts["shape"]["origin"] == "from the sequence" and len(facts["shape"]["alpha"]) > 0
    digest = hashlib.sha256(artifact_path("hand.npz").read_bytes()).hexdigest()
    assert facts["artifacts"]["models/hand.npz"] == digest
    assert facts["start"] == {"origin": "found by the tracker", "frame": 0, "pose": None}


def test_the_video_shows_every_frame(run: Path) -> None:
    video = cv2.VideoCapture(str(run / "overlay.mp4"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == COUNT and pictures[0].shape == (480, 1280, 3)
    left, right = pictures[3][:, :640], pictures[3][:, 640:]
    assert (left.max(-1) > 80).mean() > 0.02 and (right.max(-1) > 80).mean() > 0.02


def test_what_is_printed(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert track(sequence, tmp_path / "out") == 0
    printed = capsys.readouterr()
    for text in (
        "frames per second, median", "depth error, median", "state tracking", "keypoint error",
        "shape: from the sequence", "found by the tracker", str(tmp_path / "out"),
    ):  # fmt: skip
        assert text in printed.out
    assert not printed.err, "no progress bar off a terminal"


def test_shape_side_and_first_pose_can_be_given(
    sequence: Path, folder: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert track(sequence, tmp_path / "mean", "--shape", "mean") == 0
    assert "shape: mean hand" in capsys.readouterr().out
    with open_sequence(sequence) as opened:
        assert opened.subject is not None and opened.subject.alpha is not None
        shape = HandShape(alpha=opened.subject.alpha, beta=opened.subject.beta)  # type: ignore[arg-type]
        truth = opened[0].truth  # type: ignore[index]
    shape.save(tmp_path / "shape.npz")
    (tmp_path / "start.json").write_text(json.dumps({"pose": truth.pose.tolist()}))
    plain = ["--tracker", "model_based"]
    assert track(sequence, tmp_path / "labels", *plain) == 0
    assert "labels of frame 0" in capsys.readouterr().out
    given = [*plain, "--shape", str(tmp_path / "shape.npz"), "--start"]
    assert track(folder, tmp_path / "json", *given, str(tmp_path / "start.json")) == 0
    assert track(folder, tmp_path / "npz", *given, str(run / "results.npz")) == 0
    reference = results(tmp_path / "labels")["keypoints"]
    np.testing.assert_allclose(results(tmp_path / "json")["keypoints"], reference, atol=1e-4)
    np.testing.assert_allclose(results(tmp_path / "npz")["keypoints"], reference, atol=3e-3)
    assert "truth_keypoints" not in results(tmp_path / "json")
    assert "keypoint error" not in capsys.readouterr().out.split("metric")[-1]


def test_labels_that_are_keypoints_give_a_first_pose(sequence: Path, tmp_path: Path) -> None:
    with np.load(sequence, allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files if name != "truth_pose"}
    # The first frames are not labelled.
    arrays["truth_keypoints"][:2] = np.nan
    np.savez(tmp_path / "s.npz", **arrays)
    assert track(tmp_path / "s.npz", tmp_path / "out", "--tracker", "model_based") == 0
    found = results(tmp_path / "out")
    assert found["state"].tolist() == ["no_hand"] * 2 + ["tracking"] * (COUNT - 2)
    assert np.isnan(found["keypoints"][:2]).all()
    error = np.linalg.norm(found["keypoints"] - found["truth_keypoints"], axis=-1)[2:]
    assert 1e3 * error.mean() < 8.0
    with (tmp_path / "out" / "results.csv").open(newline="") as file:
        first = next(csv.DictReader(file))
    assert first["state"] == "no_hand" and first["tx_m"] == "" and first["index_tip_x_m"] == ""


def test_the_tracker_of_the_thesis_can_be_chosen(sequence: Path, tmp_path: Path) -> None:
    assert track(sequence, tmp_path / "out", "--tracker", "thesis", "--seed", "4") == 0
    facts = json.loads((tmp_path / "out" / "config.json").read_text())
    assert facts["tracker"] == "thesis" and facts["seed"] == 4
    assert facts["tracker_config"]["fit"]["silhouette_weight"] == 0


def test_a_damaged_frame_does_not_end_the_run(
    folder: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder, tmp_path / "seq")
    image = tmp_path / "seq" / "000003.png"
    image.write_bytes(image.read_bytes()[:-200])
    (tmp_path / "seq" / "000005.png").write_bytes(b"")
    start = ["--start", str(run / "results.npz"), "--video"]
    assert track(tmp_path / "seq", tmp_path / "out", *start) == 0
    found = results(tmp_path / "out")
    assert found["state"].tolist() == [
        "tracking", "tracking", "tracking", "lost", "recovered", "lost", "recovered", "tracking",
    ]  # fmt: skip
    assert "000003.png" in found["problem"][3] and found["problem"][4] == ""
    assert np.isfinite(found["pose"]).all()
    printed = capsys.readouterr().out
    assert "2 of 8 frames" in printed and "000003.png" in printed


def test_the_results_are_measured_by_eval(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(run)]) == 0
    assert f"{COUNT}" in capsys.readouterr().out


def test_rotations_are_unit_quaternions_of_the_camera_frame(run: Path) -> None:
    found = results(run)
    rotation = quat_to_matrix(found["pose"][:, 3:7])
    np.testing.assert_allclose(np.linalg.norm(found["pose"][:, 3:7], axis=1), 1.0, atol=1e-6)
    along = found["keypoints"][:, 9] - found["keypoints"][:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # The palm's x axis points to the middle finger's knuckle.
    assert ((along * rotation[:, :, 0]).sum(1) > 0.95).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.npz"], "no file or folder"),
        (["FOLDER", "--tracker", "model_based"], "--tracker hybrid"),
        (["FOLDER", "--start", "none.json"], "no first pose at none.json"),
        (["FOLDER", "--start", "bad.json"], "cannot be read as a pose"),
        (["FOLDER", "--start", "short.json"], "28 finite numbers"),
        (["FOLDER", "--start", "still.json"], "quaternion"),
        (["SEQUENCE", "--shape", "none.npz"], "no hand shape at none.npz"),
        (["SEQUENCE", "--device", "cuda:99"], "cuda:99"),
        (["SEQUENCE", "--format", "png"], "hand.json is missing"),
        (["SEQUENCE", "--out", "bad.json"], "is a file"),
        (["corrupt.npz"], "corrupt.npz"),
        (["text.npz"], "text.npz"),
    ],
)
def test_bad_usage_is_one_line_and_exit_code_2(
    sequence: Path,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "short.json").write_text("[1, 2, 3]")
    (tmp_path / "still.json").write_text(json.dumps([0.0] * 28))
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "corrupt.npz").write_bytes(sequence.read_bytes()[:5000])
    places = {"FOLDER": str(folder), "SEQUENCE": str(sequence)}
    words = [places.get(word, word) for word in words]
    assert main(["track", *words, *([] if "--out" in words else ["--out", "out"])]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.count("\n") == 1 and not printed.out
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


@pytest.mark.data
def test_labelled_joints_of_nyu_give_first_pose_and_size(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert track(recordings / "real" / "nyu_test_0000001.png", tmp_path / "out", "--video") == 0
    assert "times as large (labels)" in capsys.readouterr().out
    found = results(tmp_path / "out")
    assert found["state"].tolist() == ["tracking"] and found["scale"] != 1.0


def test_an_interrupted_run_keeps_what_it_has(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(monkeypatch, 5)
    assert track(sequence, tmp_path / "out", "--video") == 130
    assert len(results(tmp_path / "out")["pose"]) == 4
    assert (tmp_path / "out" / "overlay.mp4").is_file()


def test_a_live_source_is_tracked_and_recorded_until_enough_frames(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ["--frames", "5", "--record", str(tmp_path / "kept"), "--tracker", "hybrid"]
    with open_sequence(sequence) as truth:
        side, shape = truth.subject.side, truth.camera.shape  # type: ignore[union-attr]
    assert main(["track", f"replay:{sequence}", "--out", str(tmp_path / "out"), *more]) == 0
    found = results(tmp_path / "out")
    assert found["frame_index"].tolist() == list(range(5)) and (np.diff(found["time"]) > 0).all()
    printed = capsys.readouterr().out
    assert "frames dropped" in printed and f"recorded to {tmp_path / 'kept'}: 5 frames" in printed
    with open_sequence(tmp_path / "kept") as kept:
        assert kept.camera.shape == shape and kept.subject.side == side  # type: ignore[union-attr]
        assert [frame.problem for frame in kept] == [None] * 5
        np.testing.assert_allclose([frame.time for frame in kept], found["time"], atol=1e-5)


def test_a_killed_run_leaves_a_readable_recording(sequence: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    words = [sys.executable, "-m", "handtrack", "track", f"replay:{sequence}", "--device", "cpu"]
    process = subprocess.Popen(
        [*words, "--out", str(tmp_path / "out"), "--record", str(kept)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        end = time.monotonic() + 120
        while len(list(kept.glob("*.png"))) < 12:
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    with open_sequence(kept) as recording, open_sequence(sequence) as truth:
        frames, known = list(recording), [frame.depth for frame in truth]
    assert len(frames) >= 12
    for frame in frames:
        assert frame.problem is None
        assert min(np.abs(frame.depth - depth).max() for depth in known) < 1e-4


def test_every_format_can_be_forced() -> None:
    assert get_args(FormatName) == FORMATS


def test_help_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", "--help"]) == 0
    assert "handtrack track data/demo.npz --out out/demo --video" in capsys.readouterr().out
