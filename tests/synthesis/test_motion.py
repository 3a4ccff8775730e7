"""Motions: what may be one, what a file keeps, and the ones that come with handtrack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.model import HandModel
from handtrack.synthesis.motion import Motion, motion_names
from handtrack.transforms import quat_to_matrix, rotvec_to_matrix


def some_motion(count: int = 10, **changes: object) -> Motion:
    """A motion of three takes."""
    rng = np.random.default_rng(3)
    facts = {
        "poses": rng.normal(0, 0.3, (count, 27)).astype(np.float32),
        "elbows": rng.normal(0, 0.3, (count, 3)).astype(np.float32),
        "segment_starts": np.array([0, 4, 7]),
        "frames_per_second": 50.0,
        "name": "some",
        "source": "a test",
        "licence": "CC0-1.0",
    }
    return Motion(**{**facts, **changes})  # type: ignore[arg-type]


def test_poses_are_the_same_rotation_and_angles() -> None:
    motion = some_motion()
    poses = motion.to_poses()
    assert poses.shape == (10, 28)
    np.testing.assert_allclose(poses[:, :3], motion.poses[:, :3])
    np.testing.assert_allclose(poses[:, 7:], motion.poses[:, 6:])
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:7], axis=1), 1.0)
    np.testing.assert_allclose(
        quat_to_matrix(poses[:, 3:7]), rotvec_to_matrix(motion.poses[:, 3:6]), atol=1e-12
    )


def test_pose_vectors_come_back() -> None:
    poses = some_motion().to_poses()
    poses[3, 3:7] = [0.0, 1.0, 0.0, 0.0]  # half a turn
    again = Motion.from_poses(poses, name="x", source="", licence="").to_poses()
    plain = [0, 1, 2, *range(7, 28)]
    np.testing.assert_allclose(again[:, plain], poses[:, plain], atol=1e-6)
    np.testing.assert_allclose(
        quat_to_matrix(again[:, 3:7]), quat_to_matrix(poses[:, 3:7]), atol=2e-6
    )


@pytest.mark.parametrize("bare", [False, True])
def test_a_file_keeps_everything(tmp_path: Path, bare: bool) -> None:
    changes = {"elbows": None, "frames_per_second": None} if bare else {}
    motion = some_motion(**changes)
    again = Motion.load(motion.save(tmp_path / "new" / "m.npz"))
    assert list((tmp_path / "new").iterdir()) == [tmp_path / "new" / "m.npz"]
    np.testing.assert_array_equal(again.poses, motion.poses)
    np.testing.assert_array_equal(again.segment_starts, motion.segment_starts)
    assert (again.elbows is None) == bare and again.frames_per_second == motion.frames_per_second
    assert (again.name, again.source, again.licence) == ("some", "a test", "CC0-1.0")


def test_a_part_keeps_its_cuts_and_rate() -> None:
    motion = some_motion()
    part = motion.take(2, 9, 2)
    np.testing.assert_array_equal(part.poses, motion.poses[[2, 4, 6, 8]])
    assert part.elbows is not None and motion.elbows is not None
    np.testing.assert_array_equal(part.elbows, motion.elbows[[2, 4, 6, 8]])
    assert part.segment_starts.tolist() == [0, 1, 3]
    assert part.frames_per_second == 25.0
    assert [(s.start, s.stop) for s in motion.segments] == [(0, 4), (4, 7), (7, 10)]
    assert len(motion.take(-3)) == 3
    with pytest.raises(InputError, match="it has 10 frames"):
        motion.take(20)
    with pytest.raises(InputError, match="stride"):
        motion.take(0, None, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.zeros((10, 28))}, r"\(10, 28\): expected \(n, 27\)"),
        ({"poses": np.zeros((0, 27))}, "expected"),
        ({"poses": np.full((10, 27), np.nan)}, "not finite"),
        ({"elbows": np.zeros((9, 3))}, "10 poses and 9 elbows"),
        ({"segment_starts": np.array([1, 4])}, "ascending from 0"),
        ({"segment_starts": np.array([0, 10])}, "ascending from 0"),
        ({"segment_starts": np.array([0, 4, 4])}, "ascending from 0"),
        ({"frames_per_second": 0.0}, "frames_per_second"),
    ],
)
def test_what_is_no_motion_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        some_motion(**change)


def test_files_that_are_no_motion_are_told(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="recorded_hand_motion"):
        Motion.load("no_such_motion")
    with pytest.raises(MissingFileError, match=r"nothing\.npz"):
        Motion.load(tmp_path / "nothing.npz")
    path = some_motion().save(tmp_path / "m.npz")
    whole = path.read_bytes()
    for damaged in (b"", b"nonsense", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(DamagedFileError, match=r"m\.npz"):
            Motion.load(path)
    np.savez(path, format_version=1, poses=np.zeros((3, 27)))
    with pytest.raises(DamagedFileError, match="not a motion"):
        Motion.load(path)
    np.savez(path, format_version=99)
    with pytest.raises(DamagedFileError, match="format 99"):
        Motion.load(path)


def test_motions_that_come_with_handtrack_suit_our_hand() -> None:
    limits = HandModel.load().limits
    assert {"leap_hand_motion", "recorded_hand_motion"} <= set(motion_names())
    for name in motion_names():
        motion = Motion.load(name)
        assert motion.name == name and motion.source and motion.licence
        angles = motion.poses[:, 6:]
        over = np.maximum(limits[:, 0] - angles, 0) + np.maximum(angles - limits[:, 1], 0)
        assert np.degrees(over.max()) < 3.0
        # A hand is in front of its camera and does not jump within a take.
        assert (motion.poses[:, 2] > 0.05).all()
        for take in motion.segments:
            steps = np.diff(motion.poses[take, :3], axis=0)
            assert np.linalg.norm(steps, axis=1).max(initial=0) < 0.06
