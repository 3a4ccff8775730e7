"""Bags of ROS 1 and ROS 2 and MCAP files, written by the library that defines them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'handtrack[rosbag]'")

from camera.ros_bags import (
    DAMAGES,
    KINDS,
    BagWriter,
    damaged,
    told_without,
    write_depth_bag,
)
from handtrack.camera.camera import Camera
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, HandtrackError, InputError

CAMERA = Camera(width=16, height=12, fx=20.5, fy=21.0, cx=7.75, cy=6.25)
FORMATS = dict(zip(KINDS, ("rosbag1", "rosbag2", "rosbag2", "mcap"), strict=True))


@pytest.fixture
def steps() -> np.ndarray:
    steps = np.random.default_rng(0).integers(300, 900, (6, *CAMERA.shape)).astype(np.uint16)
    steps[:, 0, 0] = 0
    return steps


@pytest.mark.parametrize("kind", KINDS)
def test_millimetres_become_metres_with_the_time_of_the_sensor(tmp_path, kind, steps):
    path = write_depth_bag(tmp_path, kind, CAMERA, steps)
    with open_sequence(path) as sequence:
        assert sequence.format == FORMATS[kind]
        assert sequence.camera == CAMERA
        assert sequence.frames_per_second == pytest.approx(30, abs=0.01)
        frames = list(sequence)
        for frame, image, number in zip(frames, steps, range(6), strict=True):
            np.testing.assert_allclose(frame.depth, image * 1e-3, atol=1e-7)
            assert frame.time == pytest.approx(100 + number / 30, abs=1e-6)
            assert frame.problem is None
        for place in (4, 1, 2, 5, 0):
            np.testing.assert_array_equal(sequence[place].depth, frames[place].depth)


def test_a_single_file_of_a_ros2_bag_is_read_too(tmp_path, steps):
    folder = write_depth_bag(tmp_path, "rosbag2", CAMERA, steps)
    (file,) = folder.glob("*.db3")
    with open_sequence(file) as sequence:
        assert sequence.format == "rosbag2" and len(sequence) == 6
        np.testing.assert_allclose(sequence[3].depth, steps[3] * 1e-3, atol=1e-7)


@pytest.mark.parametrize("kind", ["rosbag1", "mcap"])
@pytest.mark.parametrize("case", ["float", "big-endian", "padded", "png", "png of floats"])
def test_encodings_give_the_same_metres(tmp_path, kind, case, steps):
    metres = (steps * 1e-3).astype(np.float32)
    metres[:, 0, 0] = np.nan
    bag = BagWriter(tmp_path, kind)
    bag.info("/depth/camera_info", CAMERA)
    tolerance = 1e-6
    for number in range(len(steps)):
        time = 1.0 + number / 60
        if case == "float":
            bag.image("/depth/image", metres[number], "32FC1", time, bag_time=time)
        elif case == "big-endian":
            bag.image("/depth/image", steps[number].astype(">u2"), "16UC1", time, bag_time=time)
        elif case == "padded":
            bag.image("/depth/image", steps[number], "mono16", time, bag_time=time, padding=6)
        elif case == "png":
            bag.compressed("/depth/image/compressedDepth", steps[number],
                           "16UC1; compressedDepth png", time, bag_time=time)  # fmt: skip
        else:
            # As compressed_depth_image_transport quantises: scale / depth + shift, 0 for none.
            scale, shift = 10000.0, -200.0
            values = np.nan_to_num(scale / metres[number] + shift)
            bag.compressed(
                "/depth/image/compressedDepth", np.round(values).astype(np.uint16),
                "32FC1; compressedDepth", time, bag_time=time, scale=scale, shift=shift,
            )  # fmt: skip
            tolerance = 0.5 * 0.9**2 / scale * 1.1
    with open_sequence(bag.close()) as sequence:
        for frame, image in zip(sequence, steps, strict=True):
            assert frame.problem is None
            np.testing.assert_allclose(frame.depth, image * 1e-3, atol=tolerance)


def test_the_full_image_is_taken_where_the_compressed_one_is_there_too(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag2")
    bag.info("/depth/camera_info", CAMERA)
    bag.compressed("/depth/image/compressedDepth", steps[0], "16UC1; compressedDepth", 1.0,
                   bag_time=1.0)  # fmt: skip
    bag.image("/depth/image", steps[0], "16UC1", 1.0, bag_time=1.0)
    with open_sequence(bag.close()) as sequence:
        assert sequence[0].name == "/depth/image[0]"


@pytest.fixture
def two_depths(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag1")
    for name, unit in (("/camera/depth", 1), ("/camera/aligned", 2)):
        bag.info(f"{name}/camera_info", CAMERA)
        for number in range(3):
            time = 1.0 + number / 30
            bag.image(f"{name}/image_raw", steps[number] * unit, "16UC1", time, bag_time=time)
    return bag.close()


def test_several_depth_topics_are_listed_and_one_can_be_chosen(two_depths, steps):
    with pytest.raises(InputError, match=r"--topic.*/camera/aligned/image_raw, /camera/depth"):
        open_sequence(two_depths)
    with open_sequence(two_depths, topic="/camera/aligned/image_raw") as sequence:
        np.testing.assert_allclose(sequence[2].depth, steps[2] * 2e-3, atol=1e-6)
    with pytest.raises(
        InputError, match=r"no image topic '/none'.*/camera/depth/image_raw \(16UC1"
    ):
        open_sequence(two_depths, topic="/none")


def test_a_topic_is_refused_for_formats_that_have_none(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.ones(CAMERA.shape, np.uint16))
    with pytest.raises(InputError, match="knows no topics"):
        open_sequence(tmp_path, topic="/depth", camera=CAMERA, depth_unit=0.001)


def test_a_bag_without_depth_says_what_there_is(tmp_path):
    bag = BagWriter(tmp_path, "mcap")
    bag.image("/color", np.zeros((4, 4, 3), np.uint8), "rgb8", 1.0, bag_time=1.0)
    with pytest.raises(InputError, match=r"no depth image.*/color \(rgb8\)"):
        open_sequence(bag.close())


def test_a_camera_is_needed_and_may_be_given(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag1")
    bag.image("/depth/image", steps[0], "16UC1", 1.0, bag_time=1.0)
    path = bag.close()
    with pytest.raises(InputError, match=r"/depth/camera_info.*camera="):
        open_sequence(path)
    with open_sequence(path, camera=CAMERA, depth_unit=0.0001) as sequence:
        np.testing.assert_allclose(sequence[0].depth, steps[0] * 1e-4, atol=1e-8)
    with pytest.raises(InputError, match=r"32x24.*16x12"):
        open_sequence(path, camera=CAMERA.resize(32, 24))


def test_times_that_run_backwards_are_replaced_by_those_of_the_bag(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag1")
    bag.info("/depth/camera_info", CAMERA)
    for number, stamp in enumerate((5.0, 4.0, 6.0)):
        bag.image("/depth/image", steps[number], "16UC1", stamp, bag_time=10.0 + number)
    with open_sequence(bag.close()) as sequence:
        assert [frame.time for frame in sequence] == [10.0, 11.0, 12.0]


def test_images_of_the_same_time_are_all_read(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag2")
    bag.info("/depth/camera_info", CAMERA)
    for number in range(3):
        bag.image("/depth/image", steps[number], "16UC1", 1.0, bag_time=2.0)
    with open_sequence(bag.close()) as sequence:
        for place in (2, 0, 1):
            np.testing.assert_allclose(sequence[place].depth, steps[place] * 1e-3, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_bags_give_a_one_line_error_or_flagged_frames(tmp_path, kind, damage, steps):
    path = write_depth_bag(tmp_path, kind, CAMERA, steps)
    file = next(f for f in path.iterdir() if f.suffix != ".yaml") if path.is_dir() else path
    file.write_bytes(damaged(file.read_bytes(), damage))
    try:
        with open_sequence(path) as sequence:
            frames = list(sequence)
    except HandtrackError as error:
        assert "\n" not in str(error)
        assert str(file.name) in str(error) or str(path) in str(error)
        return
    assert damage != "cut" or len(frames) < 6, "a cut bag cannot hold everything"
    for frame in frames:
        assert frame.problem is None or "\n" not in frame.problem


def test_an_image_that_is_cut_short_is_flagged_and_the_next_is_read(tmp_path, steps):
    bag = BagWriter(tmp_path, "rosbag1")
    bag.info("/depth/camera_info", CAMERA)
    for number in range(3):
        # Claims more lines than it has.
        shape = 12 if number != 1 else 6
        message = bag.make("sensor_msgs/msg/Image", bag.header(1.0 + number), 12, 16, "16UC1", 0,
                           32, steps[number][:shape].view(np.uint8).ravel())  # fmt: skip
        bag.write("/depth/image", "sensor_msgs/msg/Image", message, 1.0 + number)
    with open_sequence(bag.close()) as sequence:
        assert [frame.problem is None for frame in sequence] == [True, False, True]
        with pytest.raises(DamagedFileError, match=r"/depth/image\[1\].*16x12"):
            sequence.read(1)


def test_a_bag_under_another_name_says_so(tmp_path, steps):
    path = write_depth_bag(tmp_path, "rosbag1", CAMERA, steps)
    with pytest.raises(InputError, match=r"must end with \.bag"):
        open_sequence(path.rename(path.with_suffix(".dat")))


def test_without_rosbags_the_message_says_what_to_install(tmp_path, steps):
    path = write_depth_bag(tmp_path, "rosbag1", CAMERA, steps)
    told = told_without("rosbags", path)
    assert "pip install 'handtrack[rosbag]'" in told and told.count("\n") == 1
