import json

import cv2
import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, InputError, MissingFileError

CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)
UNIT = 0.000125


@pytest.fixture
def folder(tmp_path):
    steps = np.random.default_rng(0).integers(1, 8000, (12, *CAMERA.shape)).astype(np.uint16)
    steps[:, 0, 0] = 0
    for place, image in enumerate(steps):
        assert cv2.imwrite(str(tmp_path / f"frame{place}.png"), image)
    describe(tmp_path)
    return tmp_path, steps


def describe(folder, **changes):
    facts = CAMERA.to_dict() | {"depth_unit_m": UNIT} | changes
    facts = {name: value for name, value in facts.items() if value is not None}
    (folder / "camera.json").write_text(json.dumps(facts))


def test_values_times_unit_are_metres_in_natural_order(folder):
    path, steps = folder
    with open_sequence(path) as sequence:
        assert [frame.name for frame in sequence] == [f"frame{i}.png" for i in range(12)]
        for frame, image in zip(sequence, steps, strict=True):
            np.testing.assert_allclose(frame.depth, image * UNIT, atol=1e-7)
            assert frame.depth[0, 0] == 0


def test_nested_camera_and_frame_rate(folder):
    path, _ = folder
    facts = {"camera": CAMERA.to_dict(), "depth_unit_m": UNIT, "frames_per_second": 60}
    (path / "camera.json").write_text(json.dumps(facts))
    with open_sequence(path) as sequence:
        assert sequence.camera == CAMERA
        assert sequence.frames_per_second == 60
        assert sequence[3].time == pytest.approx(0.05)


def test_time_stamps_from_the_list(folder):
    path, _ = folder
    describe(path, times_s=[0.5 * i for i in range(12)])
    with open_sequence(path) as sequence:
        assert sequence[3].time == 1.5


def test_time_stamps_from_the_table_go_by_file_name(folder):
    path, _ = folder
    lines = [f"frame{i}.png,{i * 0.1}" for i in reversed(range(12))]
    (path / "times.csv").write_text("\n".join(["file,time_s", *lines]))
    with open_sequence(path) as sequence:
        assert sequence[11].time == pytest.approx(1.1)


@pytest.mark.parametrize(
    "times", [[0.0], list(range(12))[::-1], [float("nan")] * 12, "soon", [None] * 12]
)
def test_unusable_time_stamps_are_refused(folder, times):
    describe(folder[0], times_s=times)
    with pytest.raises(InputError, match="time stamps"):
        open_sequence(folder[0])


@pytest.mark.parametrize("table", ["frame0.png,1.0\n", "file,time_s\nframe0.png,1.0\n", "\xff"])
def test_unusable_table_of_times_is_named(folder, table):
    (folder[0] / "times.csv").write_text(table, encoding="latin-1")
    with pytest.raises(DamagedFileError, match=r"times\.csv"):
        open_sequence(folder[0])


def test_missing_camera_file_comes_with_an_example_to_copy(folder):
    path, steps = folder
    (path / "camera.json").unlink()
    with pytest.raises(MissingFileError, match=r"camera\.json is missing") as caught:
        open_sequence(path)
    text = str(caught.value)
    example = json.loads(text[text.index("{") : text.index("}") + 1])
    assert Camera.from_dict(example)
    assert example["depth_unit_m"] > 0
    with open_sequence(path, camera=CAMERA, depth_unit=UNIT) as sequence:
        np.testing.assert_allclose(sequence[0].depth, steps[0] * UNIT, atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth_unit_m": None}, "lacks depth_unit_m"),
        ({"depth_unit_m": 0}, "depth_unit_m"),
        ({"depth_unit_m": "mm"}, "depth_unit_m"),
        ({"fx": None}, "lacks fx"),
        ({"fx": -3}, "fx"),
        ({"width": 32, "cx": 16}, r"frame0\.png is 16x12"),
        ({"frames_per_second": 0}, "frames_per_second"),
    ],
)
def test_wrong_camera_file_says_what_is_wrong(folder, changes, words):
    describe(folder[0], **changes)
    with pytest.raises(InputError, match=words):
        open_sequence(folder[0])


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "null", "\xff\xfe"])
def test_camera_file_that_is_no_json_object_is_damaged(folder, text):
    (folder[0] / "camera.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=r"camera\.json"):
        open_sequence(folder[0])


@pytest.mark.parametrize(
    "image", [np.zeros(CAMERA.shape, np.uint8), np.zeros((*CAMERA.shape, 3), np.uint16)]
)
def test_pictures_for_viewing_are_refused_at_once(tmp_path, image):
    assert cv2.imwrite(str(tmp_path / "0.png"), image)
    describe(tmp_path)
    with pytest.raises(InputError, match="one channel of 16 bits"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("keep", [0, 5, 20, 40, 200, -13, -1])
def test_truncated_image_is_named_and_the_next_one_is_read(folder, keep, capfd):
    path, steps = folder
    file = path / "frame5.png"
    file.write_bytes(file.read_bytes()[:keep])
    with open_sequence(path) as sequence:
        with pytest.raises(DamagedFileError, match=r"frame5\.png"):
            sequence.read(5)
        frames = list(sequence)
    assert len(frames) == 12
    assert frames[5].problem is not None
    assert "frame5.png" in frames[5].problem
    assert not frames[5].depth.any()
    assert frames[6].problem is None
    np.testing.assert_allclose(frames[6].depth, steps[6] * UNIT, atol=1e-7)
    assert capfd.readouterr().err == ""  # libpng is never shown the damaged file


def test_damaged_first_image_does_not_keep_the_others_from_being_read(folder):
    path, _ = folder
    (path / "frame0.png").write_bytes(b"")
    with open_sequence(path) as sequence:
        assert [frame.problem is None for frame in sequence] == [False] + [True] * 11


def test_one_changed_byte_is_noticed(folder):
    path, _ = folder
    file = path / "frame2.png"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10
    file.write_bytes(data)
    with open_sequence(path) as sequence, pytest.raises(DamagedFileError, match=r"frame2.*checks"):
        sequence.read(2)


def test_image_of_another_size_or_gone_is_flagged(folder):
    path, _ = folder
    cv2.imwrite(str(path / "frame1.png"), np.ones((5, 5), np.uint16))
    with open_sequence(path) as sequence:
        (path / "frame2.png").unlink()
        assert "5x5" in (sequence[1].problem or "")
        assert "does not exist" in (sequence[2].problem or "")


def test_single_image_with_its_description_and_labels(tmp_path):
    steps = np.full(CAMERA.shape, 4000, np.uint16)
    cv2.imwrite(str(tmp_path / "one.png"), steps)
    facts = {
        "camera": CAMERA.to_dict(),
        "depth_unit_m": UNIT,
        "hand": "left",
        "joints_nyu36_m": np.full((36, 3), 0.5).tolist(),
    }
    (tmp_path / "one.json").write_text(json.dumps(facts))
    with open_sequence(tmp_path / "one.png") as sequence:
        assert len(sequence) == 1
        frame = sequence[0]
    assert frame.depth == pytest.approx(0.5)
    assert sequence.subject is not None
    assert sequence.subject.side == "left"
    assert sequence.truth == {"joints"}
    assert frame.truth is not None
    assert frame.truth.joint_set == "nyu36"
    assert frame.truth.joints is not None
    assert frame.truth.joints.shape == (36, 3)
