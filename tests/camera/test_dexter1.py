"""Dexter 1: the published layout of one sequence, written small."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handtrack.camera.readers.dexter1 import CAMERA
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError

PIXELS = np.random.default_rng(2).uniform(60, 180, (4, 6, 2))
Z = np.random.default_rng(5).uniform(300, 700, (4, 6))


def steps(number: int) -> np.ndarray:
    depth = np.full(CAMERA.shape, 32001, np.uint16)  # what the camera says where it sees nothing
    depth[80:140, 100:170] = 400 + number
    return depth


@pytest.fixture
def sequence_folder(tmp_path):
    folder = tmp_path / "data" / "adbadd"
    (folder / "tof" / "depth").mkdir(parents=True)
    (folder / "annotations").mkdir()
    for number in range(4):
        cv2.imwrite(str(folder / "tof" / "depth" / f"{number}.png"), steps(number))
    flat = [f"{u:.4f}, {v:.4f}" for u, v in PIXELS.reshape(-1, 2)]
    points = [f"{u:.3f}, {v:.3f}, {z:.4f}" for (u, v), z in zip(
        PIXELS.reshape(-1, 2) - 100, Z.ravel(), strict=True
    )]  # fmt: skip
    points[7] = "32001, 32001, 32001"  # a point that could not be labelled
    (folder / "annotations" / "Pos2D.txt").write_text("\n".join(flat) + "\n")
    (folder / "annotations" / "Pos3D.txt").write_text("\n".join(points) + "\n")
    return folder


@pytest.mark.parametrize("opened", ["", "tof", "tof/depth"])
def test_depth_is_metres_and_nothing_where_the_camera_saw_nothing(sequence_folder, opened):
    with open_sequence(sequence_folder / opened) as sequence:
        assert sequence.format == "dexter1" and sequence.name == "adbadd"
        assert sequence.camera == CAMERA and sequence.frames_per_second == 25
        assert sequence.subject is not None and sequence.subject.side == "right"
        for number, frame in enumerate(sequence):
            expected = np.where(steps(number) < 32000, steps(number), 0) * 1e-3
            np.testing.assert_allclose(frame.depth, expected, atol=1e-7)
            assert frame.time == pytest.approx(number / 25)


def test_labels_lie_where_their_pixels_are(sequence_folder):
    with open_sequence(sequence_folder) as sequence:
        assert sequence.truth == {"joints"}
        for number, frame in enumerate(sequence):
            assert frame.truth is not None and frame.truth.joint_set == "dexter6"
            joints = frame.truth.joints
            assert joints is not None and joints.shape == (6, 3)
            known = np.isfinite(joints).all(1)
            assert known.tolist() == [number != 1 or point != 1 for point in range(6)]
            pixels = sequence.camera.project(joints[known])
            np.testing.assert_allclose(pixels, PIXELS[number][known], atol=1e-2)
            np.testing.assert_allclose(joints[known, 2], Z[number][known] * 1e-3, atol=1e-5)


def test_without_labels_the_images_are_read_all_the_same(sequence_folder):
    (sequence_folder / "annotations" / "Pos2D.txt").unlink()
    with open_sequence(sequence_folder) as sequence:
        assert sequence.truth == frozenset() and sequence[0].truth is None


def test_damaged_labels_and_images_are_named(sequence_folder):
    image = sequence_folder / "tof" / "depth" / "2.png"
    image.write_bytes(image.read_bytes()[:100])
    with open_sequence(sequence_folder) as sequence:
        assert [frame.problem is None for frame in sequence] == [True, True, False, True]
        assert "2.png" in (sequence[2].problem or "")
    labels = sequence_folder / "annotations" / "Pos3D.txt"
    good = labels.read_text()
    for damaged in (good[:-30], good.replace("32001", "much", 1)):
        labels.write_text(damaged)
        with pytest.raises(DamagedFileError, match=r"Pos3D\.txt"):
            open_sequence(sequence_folder)
    labels.write_text("\n".join(good.splitlines()[:12]))
    with pytest.raises(DamagedFileError, match="4 frames and"):
        open_sequence(sequence_folder)
