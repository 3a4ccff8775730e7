"""`handtrack demo`: the sample that comes with handtrack, tracked from start to end."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handtrack.artifacts import artifact_path
from handtrack.camera.source import open_sequence
from handtrack.cli import main
from handtrack.cli.demo import SAMPLE
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape


def test_the_sample_is_what_its_readme_says() -> None:
    path = artifact_path(SAMPLE)
    assert path.stat().st_size < 3e6
    with open_sequence(path) as sequence:
        frames = list(sequence)
        subject = sequence.subject
    assert len(frames) == 150 and frames[0].camera.shape == (240, 320)
    assert frames[30].time == pytest.approx(1.0)
    assert subject is not None and subject.alpha is not None and subject.beta is not None
    assert np.linalg.norm(subject.alpha) > 1, "not the mean hand"
    hand = HandModel.load().shaped(HandShape(alpha=subject.alpha, beta=subject.beta))
    for frame in frames[::15]:
        assert frame.truth is not None and frame.truth.pose is not None
        # Made with this hand model: otherwise data/make_demo.py must run again.
        np.testing.assert_allclose(
            keypoints(hand, frame.truth.pose), frame.truth.keypoints, atol=1e-4
        )
        assert frame.depth[-1].any(), "the forearm reaches the border"


def test_the_demo_tracks_the_sample(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "keypoint error, mean" in printed and "state tracking" in printed
    with np.load(tmp_path / "out" / "results.npz", allow_pickle=False) as found:
        states = found["state"].tolist()
        error = 1e3 * np.linalg.norm(found["keypoints"] - found["truth_keypoints"], axis=-1)
    assert states.count("tracking") >= 148
    assert error.mean() < 5.0 and (error.mean(1) > 20).mean() <= 0.02
    facts = json.loads((tmp_path / "out" / "config.json").read_text())
    assert facts["frames"] == 150


def test_the_demo_writes_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A short sample: painting every frame of the long one takes a while.
    from handtrack.cli import demo

    words = ["synth", "recorded_hand_motion", "--frames", "877:881", "--out"]
    assert main([*words, str(tmp_path / "s.npz"), "--device", "cpu"]) == 0
    monkeypatch.setattr(demo, "SAMPLE", str(tmp_path / "s.npz"))
    assert main(["demo", "--video", "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    video = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4
