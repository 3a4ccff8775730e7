import json

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtrack.camera.camera import Camera
from handtrack.camera.readers.npz import write_npz_sequence
from handtrack.camera.sequence import natural_key
from handtrack.camera.source import FORMATS, open_sequence, reader
from handtrack.errors import HandtrackError, InputError, MissingFileError

CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)


def write_folder(folder, count=3):
    """A folder of PNG depth in millimetres; returns the frames in metres."""
    folder.mkdir(parents=True, exist_ok=True)
    steps = np.random.default_rng(0).integers(300, 900, (count, *CAMERA.shape)).astype(np.uint16)
    for place, image in enumerate(steps):
        assert cv2.imwrite(str(folder / f"{place}.png"), image)
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_dict() | {"depth_unit_m": 0.001}))
    return steps * 0.001


def test_every_format_has_a_reader_that_describes_itself():
    for name in FORMATS:
        assert reader(name).format == name
        assert reader(name).layout


def test_unknown_format_lists_the_known_ones(tmp_path):
    write_folder(tmp_path)
    with pytest.raises(
        InputError, match=r"npz, nyu, msra, icvl, .*realsense, rosbag1, rosbag2, mcap, png"
    ):
        open_sequence(tmp_path, format="kinect")


def test_missing_source_is_named():
    with pytest.raises(MissingFileError, match="not/there"):
        open_sequence("not/there")


@pytest.mark.parametrize("source", [None, 3, ["a"]])
def test_source_that_is_no_path_is_refused(source):
    with pytest.raises(InputError, match="not a path"):
        open_sequence(source)


def test_folder_and_file_without_depth_are_described(tmp_path):
    with pytest.raises(InputError, match="empty folder"):
        open_sequence(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"notes\.txt"):
        open_sequence(tmp_path)
    with pytest.raises(InputError, match="hello"):
        open_sequence(tmp_path / "notes.txt")


def test_an_open_sequence_passes_through(tmp_path):
    write_folder(tmp_path)
    with open_sequence(tmp_path) as sequence:
        assert open_sequence(sequence) is sequence


def test_frames_are_counted_indexed_and_stamped(tmp_path):
    metres = write_folder(tmp_path, 4)
    with open_sequence(tmp_path) as sequence:
        assert len(sequence) == 4
        frames = list(sequence)
        assert [frame.index for frame in frames] == [0, 1, 2, 3]
        assert [frame.time for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30, 3 / 30])
        assert sequence.frames_per_second is None
        np.testing.assert_allclose(sequence[-1].depth, metres[3], atol=1e-6)
        np.testing.assert_allclose(sequence[np.int64(1)].depth, metres[1], atol=1e-6)
        with pytest.raises(IndexError):
            sequence[4]
        for frame in frames:
            assert frame.depth.dtype == np.float32
            assert frame.depth.flags.c_contiguous
            assert frame.camera == CAMERA
            assert frame.problem is None


def test_camera_given_by_the_caller_wins_if_its_size_fits(tmp_path):
    write_folder(tmp_path)
    other = Camera(width=16, height=12, fx=25.0, fy=25.0, cx=8.0, cy=6.0)
    with open_sequence(tmp_path, camera=other) as sequence:
        assert sequence[0].camera == other
    with pytest.raises(InputError, match=r"32x24.*16x12"):
        open_sequence(tmp_path, camera=other.resize(32, 24))
    with pytest.raises(InputError, match=r"handtrack\.Camera"):
        open_sequence(tmp_path, camera=other.to_dict())  # type: ignore[arg-type]


def test_depth_unit_given_by_the_caller_wins(tmp_path):
    metres = write_folder(tmp_path)
    with open_sequence(tmp_path, depth_unit=0.0001) as sequence:
        np.testing.assert_allclose(sequence[0].depth, metres[0] / 10, atol=1e-7)
    with pytest.raises(InputError, match="depth_unit"):
        open_sequence(tmp_path, depth_unit=-1.0)


def test_names_sort_as_people_count():
    names = ["f10.png", "f2.png", "f1.png", "a.png", "10.png", "9.png"]
    ordered = sorted(names, key=natural_key)
    assert ordered == ["9.png", "10.png", "a.png", "f1.png", "f2.png", "f10.png"]


def _damage(data: bytes, cut: int, flips: list[tuple[int, int]]) -> bytes:
    """Cut a file short and change some of its bytes."""
    damaged = bytearray(data[: max(0, len(data) - cut)])
    for place, value in flips:
        if damaged:
            damaged[place % len(damaged)] = value
    return bytes(damaged)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    kind=st.sampled_from(["npz", "png", "json"]),
    cut=st.one_of(st.just(0), st.integers(0, 5000)),
    flips=st.lists(st.tuples(st.integers(0, 10**5), st.integers(0, 255)), max_size=4),
)
def test_damaged_files_give_a_one_line_error_or_a_flagged_frame(tmp_path, kind, cut, flips):
    if kind == "npz":
        path = tmp_path / "s.npz"
        depth = np.random.default_rng(1).uniform(0.3, 0.9, (3, *CAMERA.shape))
        write_npz_sequence(path, depth, CAMERA, side="left", truth_keypoints=np.zeros((3, 21, 3)))
        victim = path
    else:
        path = tmp_path / "folder"
        write_folder(path)
        victim = path / ("1.png" if kind == "png" else "camera.json")
    victim.write_bytes(_damage(victim.read_bytes(), cut, flips))
    try:
        with open_sequence(path) as sequence:
            frames = list(sequence)
            assert len(frames) == len(sequence)
    except HandtrackError as error:
        assert "\n" not in str(error)
        assert str(error)
        return
    for frame in frames:
        assert np.isfinite(frame.depth).all()
        if frame.problem is not None:
            assert "\n" not in frame.problem
            assert not frame.depth.any()
