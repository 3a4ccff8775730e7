import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.readers import npz
from handtrack.camera.readers.npz import write_npz_sequence
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, InputError

CAMERA = Camera(width=16, height=12, fx=20.0, fy=21.0, cx=8.0, cy=6.0)
DEPTH = np.random.default_rng(0).uniform(0.3, 0.9, (5, *CAMERA.shape)).astype(np.float32)
DEPTH[:, :2] = 0.0
SIX = np.array([16, 12, 20.0, 21.0, 8.0, 6.0])


def test_everything_written_is_read_back(tmp_path):
    generator = np.random.default_rng(1)
    pose, keypoints = generator.normal(size=(5, 28)), generator.normal(size=(5, 21, 3))
    time = np.array([0.0, 0.1, 0.2, 0.3, 0.5])
    path = write_npz_sequence(
        tmp_path / "deep" / "s.npz", DEPTH, CAMERA, depth_unit=0.0001, time=time,
        frames_per_second=10.0, truth_pose=pose, truth_keypoints=keypoints, side="left",
        shape_alpha=[0.5, -1.0], shape_beta=[0.25], scale=1.1, source="test", licence="CC0-1.0",
    )  # fmt: skip
    with open_sequence(path) as sequence:
        assert (sequence.camera, len(sequence), sequence.name) == (CAMERA, 5, "s")
        assert sequence.truth == {"pose", "keypoints"}
        assert sequence.frames_per_second == 10
        assert sequence.subject is not None
        assert (sequence.subject.side, sequence.subject.scale) == ("left", 1.1)
        np.testing.assert_array_equal(sequence.subject.alpha, [0.5, -1.0])
        np.testing.assert_array_equal(sequence.subject.beta, [0.25])
        for index, frame in enumerate(sequence):
            # Half a step of the unit, and float32 rounding.
            np.testing.assert_allclose(frame.depth, DEPTH[index], atol=0.5e-4 + 1e-7)
            assert not frame.depth[:2].any()
            assert frame.time == time[index]
            np.testing.assert_array_equal(frame.truth.pose, pose[index])
            np.testing.assert_allclose(frame.truth.keypoints, keypoints[index], rtol=1e-6)
            assert frame.truth.side == "left"


def test_frames_can_be_read_in_any_order_and_again(tmp_path):
    path = write_npz_sequence(tmp_path / "s.npz", iter(DEPTH), CAMERA)
    with open_sequence(path) as sequence:
        for index in (4, 0, 2, 2, 1, -1):
            np.testing.assert_allclose(sequence[index].depth, DEPTH[index], atol=0.0003)
        assert [frame.index for frame in sequence] == [frame.index for frame in sequence]


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_float_depth_needs_no_unit(tmp_path, dtype):
    np.savez(tmp_path / "f.npz", depth=DEPTH.astype(dtype), camera=SIX)
    with open_sequence(tmp_path / "f.npz") as sequence:
        np.testing.assert_allclose(sequence[1].depth, DEPTH[1].astype(dtype), rtol=1e-6)
        assert sequence[1].truth is None
        assert sequence.truth == frozenset()


def test_a_folder_stands_for_its_sequence_and_gives_its_name(tmp_path):
    write_npz_sequence(tmp_path / "demo" / "sequence.npz", DEPTH, CAMERA)
    (tmp_path / "demo" / "README.md").write_text("where it comes from")
    with open_sequence(tmp_path / "demo") as sequence:
        assert (sequence.name, len(sequence)) == ("demo", 5)
        assert sequence[0].name == "demo[0]"


def test_a_single_image_is_a_sequence_of_one(tmp_path):
    np.savez(tmp_path / "f.npz", depth=DEPTH[0], camera=SIX)
    with open_sequence(tmp_path / "f.npz") as sequence:
        assert len(sequence) == 1


def test_integer_depth_without_unit_is_refused_unless_given(tmp_path):
    path = tmp_path / "f.npz"
    np.savez(path, depth=(DEPTH * 1000).astype(np.uint16), camera=SIX)
    with pytest.raises(InputError, match="depth_unit_m"):
        open_sequence(path)
    with open_sequence(path, depth_unit=0.001) as sequence:
        np.testing.assert_allclose(sequence[0].depth, DEPTH[0], atol=0.001)


def test_camera_may_come_from_the_caller(tmp_path):
    path = tmp_path / "f.npz"
    np.savez(path, depth=DEPTH)
    with pytest.raises(InputError, match="camera"):
        open_sequence(path)
    with open_sequence(path, camera=CAMERA) as sequence:
        assert sequence.camera == CAMERA


def test_other_archives_are_described(tmp_path):
    np.savez(tmp_path / "f.npz", vertices=np.zeros(3), faces=np.zeros(3))
    with pytest.raises(InputError, match="vertices, faces"):
        open_sequence(tmp_path / "f.npz")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"depth": np.array([None])}, "object"),
        ({"depth": DEPTH[0, 0]}, "shape"),
        ({"depth": DEPTH[:0]}, "shape"),
        ({"depth": np.asfortranarray(DEPTH)}, "Fortran"),
        ({"depth": DEPTH.astype(complex)}, "complex"),
        ({"camera": SIX[:4]}, "camera"),
        ({"camera": SIX * np.nan}, "width"),
        ({"camera": SIX + np.eye(6)[0]}, "16x12"),
        ({"truth_pose": np.zeros((4, 28))}, "truth_pose"),
        ({"truth_keypoints": np.array(["a"])}, "truth_keypoints"),
        ({"format_version": 99}, "version 99"),
        ({"side": np.array([None])}, "cannot be read"),
    ],
)
def test_wrong_arrays_are_named(tmp_path, arrays, words):
    path = tmp_path / "f.npz"
    np.savez(path, **({"depth": DEPTH, "camera": SIX} | arrays))
    with pytest.raises(DamagedFileError, match=words):
        open_sequence(path)


@pytest.mark.parametrize("keep", [0, 3, 100, -1])
def test_truncated_archive_is_named(tmp_path, keep):
    path = write_npz_sequence(tmp_path / "s.npz", DEPTH, CAMERA)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DamagedFileError, match=r"s\.npz"):
        open_sequence(path)


def test_corruption_is_noticed_on_opening(tmp_path):
    path = write_npz_sequence(tmp_path / "s.npz", DEPTH, CAMERA)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"s\.npz"):
        open_sequence(path)


def test_corruption_in_a_large_file_flags_the_frames_behind_it(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "VERIFIED_BYTES", 0)
    many = np.random.default_rng(3).uniform(0.3, 0.9, (400, *CAMERA.shape))
    path = write_npz_sequence(tmp_path / "s.npz", many, CAMERA)
    data = bytearray(path.read_bytes())
    for place in range(len(data) // 2, len(data) // 2 + 64):
        data[place] = 0
    path.write_bytes(data)
    with open_sequence(path) as sequence:
        frames = list(sequence)
        np.testing.assert_allclose(frames[0].depth, many[0], atol=0.0003)
        assert frames[-1].problem is not None
        assert "corrupt" in frames[-1].problem
        assert sequence[0].problem is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": []}, "at least one"),
        ({"depth": DEPTH[:, :3]}, "frame 0"),
        ({"depth": DEPTH.astype(np.int32)}, "int32"),
        ({"depth": DEPTH * 100}, "larger depth_unit"),
        ({"depth": -DEPTH}, "larger depth_unit"),
        ({"depth_unit": 0.0}, "depth_unit"),
        ({"time": [1, 2]}, "time"),
        ({"truth_pose": np.zeros((5, 27))}, "truth_pose"),
        ({"side": "both"}, "side"),
    ],
)
def test_unusable_arguments_write_nothing(tmp_path, changes, words):
    arguments = {"depth": DEPTH, "camera": CAMERA} | changes
    with pytest.raises(InputError, match=words):
        write_npz_sequence(tmp_path / "s.npz", **arguments)
    assert list(tmp_path.iterdir()) == []
