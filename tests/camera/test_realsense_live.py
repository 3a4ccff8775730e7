"""The RealSense driver against librealsense's software device."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

pytest.importorskip(  # which finds nothing where the system's libusb is missing
    "pyrealsense2",
    reason="pyrealsense2 is not installed: pip install 'handtrack[realsense]'",
    exc_type=ImportError,
)

from handtrack.camera.camera import Camera
from handtrack.camera.live import LiveOptions, LiveSequence
from handtrack.camera.readers.realsense_live import RealSenseDriver
from handtrack.camera.readers.software_camera import SoftwareCamera, SoftwareCameraFeed
from handtrack.errors import DeviceError

CAMERA = Camera(width=64, height=48, fx=47.5, fy=47.25, cx=31.5, cy=24.5)
UNIT = 0.000125
QUICK = LiveOptions(silence=0.3, first_retry=0.02, last_retry=0.05)


@pytest.fixture
def feed():
    steps = [np.full(CAMERA.shape, 1000 + 100 * place, np.uint16) for place in range(7)]
    with SoftwareCameraFeed(SoftwareCamera(CAMERA, unit=UNIT), steps) as feed:
        yield feed


def opened(feed: SoftwareCameraFeed, serial: str = "") -> LiveSequence:
    driver = RealSenseDriver(serial, find=feed.devices)
    return LiveSequence(driver, format="realsense", options=QUICK)


def test_depth_intrinsics_unit_and_sensor_time_come_through(feed):
    with opened(feed, "software") as live:
        assert live.camera == CAMERA and live.frames_per_second == 60
        assert live.name == "Software camera software"
        frames = list(itertools.islice(live, 10))
    for frame in frames:
        assert frame.received is not None
        assert 0 <= frame.received - frame.time < 1.0  # the feed stamps by the same clock
        step = frame.depth[0, 0] / UNIT
        assert step == pytest.approx(round(step / 100) * 100, abs=0.01)
        assert (frame.depth == frame.depth[0, 0]).all()
    assert (np.diff([frame.time for frame in frames]) > 0).all()


def test_frames_dropped_by_a_slow_consumer_are_counted(feed):
    with opened(feed) as live:
        frames = iter(live)
        first = next(frames)
        time.sleep(0.4)
        next(frames)
        last = next(frames)
        passed = round((last.time - first.time) * 60)
        # Between the first and the last lie the one in the middle and those dropped.
        assert live.dropped == pytest.approx(passed - 2, abs=3)
        assert live.dropped > 10


def test_an_unplugged_camera_is_taken_up_again(feed):
    with opened(feed) as live:
        frames = iter(live)
        next(frames)
        feed.plugged.clear()
        lost = next(frame for frame in frames if frame.problem is not None)
        assert "sent nothing" in lost.problem or "unplugged" in lost.problem
        assert live.status == "reconnecting"
        time.sleep(0.2)
        feed.plugged.set()
        back = next(frames)
        assert back.problem is None and back.depth.any() and live.status == "streaming"


def test_a_camera_that_is_not_there_is_named_with_those_that_are(feed):
    with pytest.raises(DeviceError, match=r"serial number 77.*found: Software camera software"):
        opened(feed, "77")
    feed.plugged.clear()
    with pytest.raises(DeviceError, match="no RealSense camera connected"):
        opened(feed)
