"""Recordings of librealsense: written by its recorder, and .bag files in its published layout."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'handtrack[rosbag]'")
pytest.importorskip(  # which finds nothing where the system's libusb is missing
    "pyrealsense2",
    reason="pyrealsense2 is not installed: pip install 'handtrack[realsense]'",
    exc_type=ImportError,
)

import pyrealsense2 as rs

from camera.ros_bags import DAMAGES, damaged, told_without, write_realsense_bag
from handtrack.camera.camera import Camera
from handtrack.camera.readers.software_camera import SoftwareCamera
from handtrack.camera.source import open_sequence
from handtrack.errors import HandtrackError, InputError

CAMERA = Camera(width=64, height=48, fx=47.5, fy=47.25, cx=31.5, cy=24.5)
UNIT = 0.000125


@pytest.fixture(scope="module")
def steps() -> np.ndarray:
    steps = np.random.default_rng(0).integers(300, 9000, (20, *CAMERA.shape)).astype(np.uint16)
    steps[:, 0, 0] = 0
    return steps


@pytest.fixture(scope="module", params=["bag", "db3"])
def recording(request, steps, tmp_path_factory):
    path = tmp_path_factory.mktemp("realsense") / f"camera.{request.param}"
    if request.param == "bag":
        return write_realsense_bag(path, CAMERA, steps, UNIT)
    if not rs.__version__ >= "2.58":
        pytest.skip(f"librealsense {rs.__version__} does not write .db3")
    device = SoftwareCamera(CAMERA, unit=UNIT)
    recorder = rs.recorder(str(path), device.device)
    (sensor,) = recorder.query_sensors()
    frames = rs.frame_queue(50)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(frames)
    for number, image in enumerate(steps):
        device.push(image, time=5 + number / 60, number=number)
        frames.wait_for_frame(2000)
    time.sleep(0.2)  # the recorder writes in a thread of its own
    sensor.stop()
    sensor.close()
    del sensor, recorder
    return path


def test_steps_times_the_cameras_unit_are_metres(recording, steps):
    with open_sequence(recording) as sequence:
        assert sequence.format == "realsense"
        assert sequence.camera == CAMERA
        assert sequence.frames_per_second == 60
        frames = list(sequence)
        for number, (frame, image) in enumerate(zip(frames, steps, strict=True)):
            np.testing.assert_allclose(frame.depth, image * UNIT, atol=1e-7)
            assert frame.time == pytest.approx(5 + number / 60, abs=1e-5)


def test_frames_can_be_read_in_any_order_and_twice(recording, steps):
    with open_sequence(recording) as sequence:
        for place in (17, 3, 3, 4, 5, 19, 0, -1):
            np.testing.assert_allclose(sequence[place].depth, steps[place] * UNIT, atol=1e-7)


def test_unit_and_camera_can_be_given(recording, steps):
    other = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    with open_sequence(recording, camera=other, depth_unit=0.001) as sequence:
        assert sequence.camera == other
        np.testing.assert_allclose(sequence[2].depth, steps[2] * 1e-3, atol=1e-6)
    with pytest.raises(InputError, match=r"32x24.*64x48"):
        open_sequence(recording, camera=CAMERA.resize(32, 24))


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_recordings_give_a_one_line_error_or_flagged_frames(
    recording, steps, tmp_path, damage
):
    path = tmp_path / recording.name
    path.write_bytes(damaged(recording.read_bytes(), damage))
    try:
        with open_sequence(path) as sequence:
            frames = list(sequence)
    except HandtrackError as error:
        assert "\n" not in str(error) and path.name in str(error)
        return
    assert all(frame.problem is None or "\n" not in frame.problem for frame in frames)


def test_without_pyrealsense2_the_message_says_what_to_install(recording):
    told = told_without("pyrealsense2", recording, "realsense")
    assert told.count("pip install 'handtrack[realsense]'") == 2
    assert told.count("\n") == 2
