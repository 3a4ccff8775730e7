"""Recordings of grasps: checks, files, the grasp frame."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.grasp.recording import (
    STEPS,
    GraspDatabase,
    GraspRecording,
    grasp_yaw,
    turned_poses,
)
from handtrack.grasp.taxonomy import GRIPS
from handtrack.transforms import pose_difference
from oracles.made_recordings import make_database, make_recording


def recording(**changes) -> GraspRecording:
    return replace(make_recording(np.random.default_rng(1)), **changes)


def test_a_saved_database_is_read_back_to_within_its_steps(tmp_path: Path) -> None:
    database = make_database(3, grips=("tripod", "medium_wrap"))
    database.save(tmp_path / "grasps.npz")
    back = GraspDatabase.load(tmp_path / "grasps.npz")
    assert len(back) == 6 and back.grips == database.grips and back.objects == database.objects
    for mine, other in zip(database, back, strict=True):
        off = np.abs(pose_difference(other.hand_poses, mine.hand_poses))
        assert off[:, :3].max() <= 0.51 * STEPS[0]
        assert off[:, 6:].max() <= 0.51 * STEPS[2]
        assert off[:, 3:6].max() < 5e-4
        np.testing.assert_allclose(other.object_poses, mine.object_poses, atol=1e-4)
        np.testing.assert_allclose(other.contact_points, mine.contact_points, atol=1e-7)
        kept = ("grip", "object", "trial", "provenance", "frame_rate")
        assert [getattr(mine, k) for k in kept] == [getattr(other, k) for k in kept]
        assert mine.phases.tolist() == other.phases.tolist()
        assert mine.contact_bones.tolist() == other.contact_bones.tolist()


def test_the_grasp_is_the_last_frame_of_closing() -> None:
    made = recording()
    assert made.phases[made.grasp_frame] == "closing"
    assert made.phases[made.grasp_frame + 1] == "manipulation"
    assert made.duration == pytest.approx((len(made.hand_poses) - 1) / 120.0)


def test_another_frame_rate_gives_the_same_closing_motion_in_as_much_time() -> None:
    fast = make_recording(np.random.default_rng(4), frame_rate=120.0)
    slow = replace(fast, frame_rate=60.0)
    motion = slow.closing_in_grasp_frame
    closing = fast.closing_in_grasp_frame
    assert len(motion) == 2 * (len(closing) - 1) + 1
    assert np.abs(pose_difference(motion[::2], closing)).max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(motion[:, 3:7], axis=1), 1.0, atol=1e-12)


def test_turning_by_the_grasp_yaw_puts_the_hand_on_the_negative_x_axis() -> None:
    pose = turned_poses(recording().hand_poses[0], 2.1, [0.05, 0.2, 0.0])
    centre = np.array([0.3, -0.1, 0.0])
    yaw = grasp_yaw(pose, centre)
    placed = turned_poses(pose, -yaw)
    moved = turned_poses(np.array([*centre, 1.0, 0.0, 0.0, 0.0]), -yaw)[:3]
    way = moved - placed[:3]
    assert way[0] > 0 and abs(way[1]) < 1e-9


def test_own_recordings_join_the_database() -> None:
    database = make_database(2).joined([recording(provenance="mine", grip="quadpod")])
    assert len(database) == 3 and set(database.grips) == {"tripod", "quadpod"}
    assert [r.provenance for r in database.of_grip("quadpod")] == ["mine"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grip": "karate"}, "no grip mode"),
        ({"hand_poses": np.zeros((4, 28))}, "has shape"),
        ({"contact_bones": np.array([1])}, "has shape"),
        ({"frame_rate": 0.0}, "frame_rate"),
        ({"contact_bones": np.array([3, 6, 40])}, "bone that does not exist"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        recording(**changes)


def test_bad_numbers_quaternions_and_phases_are_refused() -> None:
    made = recording()
    hands = made.hand_poses.copy()
    hands[3, 5] = np.nan
    with pytest.raises(InputError, match="not finite"):
        recording(hand_poses=hands)
    with pytest.raises(InputError, match="length one"):
        recording(object_poses=2.0 * made.object_poses)
    with pytest.raises(InputError, match="phase 'flying'"):
        recording(phases=np.where(made.phases == "closing", "flying", made.phases))
    with pytest.raises(InputError, match="out of order"):
        recording(phases=made.phases[::-1])
    with pytest.raises(InputError, match="fewer than two"):
        recording(phases=np.where(made.phases == "closing", "reaching", made.phases))


def test_a_pose_too_far_away_is_not_stored(tmp_path: Path) -> None:
    hands = recording().hand_poses.copy()
    hands[0, 0] = 2.0
    with pytest.raises(InputError, match="the limit is"):
        GraspDatabase((recording(hand_poses=hands),)).save(tmp_path / "far.npz")
    assert not (tmp_path / "far.npz").exists()


def test_missing_and_damaged_files_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError):
        GraspDatabase.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"not a database")
    with pytest.raises(DamagedFileError):
        GraspDatabase.load(tmp_path / "bad.npz")
    make_database(2).save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as data:
        arrays = dict(data)
    for name, value in (("format_version", 99), ("grips", np.array(["karate", "karate"]))):
        np.savez(tmp_path / "other.npz", **{**arrays, name: value})
        with pytest.raises(DamagedFileError):
            GraspDatabase.load(tmp_path / "other.npz")
    del arrays["phases"]
    np.savez(tmp_path / "less.npz", **arrays)
    with pytest.raises(DamagedFileError):
        GraspDatabase.load(tmp_path / "less.npz")


def test_every_field_is_in_the_file(tmp_path: Path) -> None:
    make_database(1).save(tmp_path / "grasps.npz")
    names = set(np.load(tmp_path / "grasps.npz").files)
    held = {f.name for f in fields(GraspRecording)}
    singular = {n.rstrip("s") for n in names} | names
    assert {name for name in held if name not in singular} == set()
    assert GRIPS  # the file names grip modes of this taxonomy
