"""Reading results.npz, and which pose stands where the hand was not followed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.export.track import DEFAULT_INTERVAL, Track, read_track
from handtrack.tracking.result import HandResult, TrackState


def test_a_run_is_read_as_it_was_written(
    track: Track, hand_results: list[HandResult], side: str
) -> None:
    assert track.side == side and track.source == "somewhere"
    assert track.problems[0] == "nothing there" and track.problems[5] == ""
    for place, result in enumerate(hand_results):
        assert track.states[place] is result.state
        np.testing.assert_array_equal(track.poses[place], result.pose)
        np.testing.assert_array_equal(track.keypoints[place], result.keypoints)
        np.testing.assert_array_equal(track.keypoint_std[place], result.keypoint_std)
    np.testing.assert_allclose(track.hand.local_vertices, hand_results[0].hand.local_vertices)
    assert track.interval == pytest.approx((track.times[-1] - 100.0) / 15)


def test_held_poses_stand_still_where_the_hand_was_not_followed(track: Track) -> None:
    held = track.held_poses()
    assert np.isfinite(held).all()
    np.testing.assert_array_equal(held[:3], np.repeat(track.poses[2:3], 3, axis=0))
    np.testing.assert_array_equal(held[8:11], np.repeat(track.poses[7:8], 3, axis=0))
    np.testing.assert_array_equal(held[track.followed], track.poses[track.followed])


def test_a_stale_pose_of_a_lost_frame_is_not_taken(track: Track) -> None:
    poses = track.poses.copy()
    poses[9, :3] += 1.0
    np.testing.assert_array_equal(replace(track, poses=poses).held_poses(), track.held_poses())


def test_a_hand_that_was_never_followed_has_no_motion(track: Track) -> None:
    never = replace(track, states=(TrackState.LOST,) * len(track))
    with pytest.raises(InputError, match="none of 16 frames"):
        never.held_poses()


def test_time_stamps_that_stand_still_mean_the_usual_rate(track: Track) -> None:
    assert replace(track, times=np.zeros(len(track))).interval == DEFAULT_INTERVAL


def damage(folder: Path, out: Path, **changes: object) -> Path:
    """A copy of the results with arrays replaced, or left out where None."""
    with np.load(folder / "results.npz") as data:
        arrays = {**data, **changes}
    np.savez(out, **{name: value for name, value in arrays.items() if value is not None})  # type: ignore[arg-type]
    return out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format_version": 9}, "format 9"),
        ({"pose": None}, "pose"),
        ({"pose": np.zeros((3, 28))}, "poses have shape"),
        ({"pose": np.full((16, 28), np.nan)}, "not finite"),
        ({"pose": np.zeros((16, 28))}, "quaternion"),
        ({"state": np.array(["asleep"] * 16)}, "asleep"),
        ({"side": "middle"}, "middle"),
        ({"time": np.full(16, np.nan)}, "time stamp"),
        ({"frame_index": np.zeros(0, np.int64)}, "no frames"),
        ({"pose_names": np.array(["x"] * 28)}, "named otherwise"),
        ({"keypoints": np.zeros((16, 20, 3))}, "keypoints have shape"),
    ],
)
def test_what_is_no_run_is_refused(
    folder: Path, tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    with pytest.raises(DamagedFileError, match=words) as caught:
        read_track(damage(folder, tmp_path / "bad.npz", **changes))
    assert "bad.npz" in str(caught.value)


def test_cut_off_and_missing_files_are_refused(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "results.npz").read_bytes()
    for share in (0.0, 0.3, 0.95):
        (tmp_path / "cut.npz").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DamagedFileError, match=r"cut\.npz"):
            read_track(tmp_path / "cut.npz")
    with pytest.raises(MissingFileError, match="no such file"):
        read_track(tmp_path)
