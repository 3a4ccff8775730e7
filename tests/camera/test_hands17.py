"""HANDS 2017 and BigHand2.2M: the published layouts, written small."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handtrack.camera.readers.hands17 import CAMERA
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, MissingFileError

JOINTS = np.random.default_rng(3).normal(size=(3, 21, 3)) * 40 + [0, 0, 500]


def steps(number: int) -> np.ndarray:
    depth = np.zeros(CAMERA.shape, np.uint16)
    depth[200:260, 300:360] = 450 + number
    return depth


def label(name: str, joints: np.ndarray) -> str:
    return "\t".join([name, *(f"{value:.4f}" for value in joints.ravel())])


@pytest.fixture
def challenge(tmp_path):
    folder = tmp_path / "training"
    (folder / "images").mkdir(parents=True)
    names = [f"image_D{number:08d}.png" for number in (1, 2, 3)]
    for number, name in enumerate(names):
        cv2.imwrite(str(folder / "images" / name), steps(number))
    lines = [label(name, row) for name, row in zip(names, JOINTS, strict=True)]
    (folder / "Training_Annotation.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("opened", ["", "Training_Annotation.txt", "images"])
def test_depth_and_labels_are_metres(challenge, opened):
    with open_sequence(challenge / opened) as sequence:
        assert sequence.format == "hands17" and sequence.camera == CAMERA
        assert len(sequence) == 3 and sequence.truth == {"keypoints", "joints"}
        for number, frame in enumerate(sequence):
            np.testing.assert_allclose(frame.depth, steps(number) * 1e-3, atol=1e-7)
            assert frame.truth is not None and frame.truth.joint_set == "hands17"
            np.testing.assert_allclose(frame.truth.joints, JOINTS[number] * 1e-3, atol=1e-6)


def test_keypoints_are_in_our_order(challenge):
    names = ("wrist T0 I0 M0 R0 P0 T1 T2 T3 I1 I2 I3 M1 M2 M3 R1 R2 R3 P1 P2 P3").split()
    ours = ["wrist", *(f"{finger}{joint}" for finger in "TIMRP" for joint in range(4))]
    with open_sequence(challenge) as sequence:
        truth = sequence[0].truth
    assert truth is not None and truth.keypoints is not None
    expected = JOINTS[0, [names.index(name) for name in ours]] * 1e-3
    np.testing.assert_allclose(truth.keypoints, expected, atol=1e-6)


def test_bighand_paths_hold_spaces_and_backslashes(tmp_path):
    folder = tmp_path / "Subject_1" / "76 150"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "image_D00016005.png"), steps(4))
    labels = tmp_path / "train.txt"
    labels.write_text(label("Subject_1\\76 150\\image_D00016005.png", JOINTS[0]) + "\n")
    with open_sequence(labels) as sequence:
        assert sequence.format == "hands17" and len(sequence) == 1
        np.testing.assert_allclose(sequence[0].depth, steps(4) * 1e-3, atol=1e-7)
    with open_sequence(folder) as sequence:  # without labels
        assert sequence.format == "hands17" and sequence[0].truth is None


def test_damaged_labels_and_images_are_named(challenge):
    image = challenge / "images" / "image_D00000002.png"
    image.write_bytes(image.read_bytes()[:300])
    with open_sequence(challenge) as sequence:
        assert [frame.problem is None for frame in sequence] == [True, False, True]
        assert "image_D00000002.png" in (sequence[1].problem or "")
    labels = challenge / "Training_Annotation.txt"
    labels.write_text(labels.read_text()[:-200])
    with pytest.raises(DamagedFileError, match=r"Training_Annotation\.txt.*line 3"):
        open_sequence(challenge)


def test_labels_without_their_images_say_where_they_are_looked_for(challenge, tmp_path):
    alone = tmp_path / "elsewhere" / "Training_Annotation.txt"
    alone.parent.mkdir()
    alone.write_text((challenge / "Training_Annotation.txt").read_text())
    with pytest.raises(MissingFileError, match=r"image_D00000001\.png.*images"):
        open_sequence(alone)
