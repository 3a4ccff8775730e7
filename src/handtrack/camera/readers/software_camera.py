"""A depth camera without hardware: librealsense's software device, fed with images.

Everything behind the device is the library's own, so live sources can be measured and tested on a
machine without a camera.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.optional import import_extra


class SoftwareCamera:
    """A RealSense device made of software.

    Args:
        camera: Its intrinsics.
        unit: What one step of its depth is [m].
        frames_per_second: Its nominal frame rate [1/s].
        serial: Its serial number.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        unit: float = 0.001,
        frames_per_second: int = 60,
        serial: str = "software",
    ) -> None:
        self._rs = rs = import_extra("pyrealsense2", "realsense", "the software camera")
        self.camera, self.unit, self.frames_per_second = camera, unit, frames_per_second
        lens = rs.intrinsics()
        lens.width, lens.height, lens.model = camera.width, camera.height, rs.distortion.none
        lens.fx, lens.fy, lens.ppx, lens.ppy = camera.fx, camera.fy, camera.cx, camera.cy
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.intrinsics = rs.stream.depth, rs.format.z16, lens
        stream.index, stream.uid, stream.bpp, stream.fps = 0, 0, 2, frames_per_second
        stream.width, stream.height = camera.width, camera.height
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software camera")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self._sensor = self.device.add_sensor("Depth")
        self._profile = self._sensor.add_video_stream(stream).as_video_stream_profile()
        self._sensor.add_read_only_option(rs.option.depth_units, unit)

    def push(self, steps: NDArray[np.uint16], *, time: float, number: int) -> None:
        """Let the camera see an image; nobody gets it while the stream is not started.

        Args:
            steps: Depth in steps of the unit, shape (height, width).
            time: Time stamp [s].
            number: Number of the frame.
        """
        frame = self._rs.software_video_frame()
        frame.pixels = np.ascontiguousarray(steps, np.uint16)
        frame.stride, frame.bpp = 2 * self.camera.width, 2
        frame.timestamp, frame.domain = 1e3 * time, self._rs.timestamp_domain.system_time
        frame.frame_number, frame.profile = number, self._profile
        frame.depth_units = self.unit
        self._sensor.on_video_frame(frame)


class SoftwareCameraFeed:
    """Feeds a software camera with images over and over, at its rate, from a thread.

    Frames are stamped with `time.perf_counter`. Use it in a ``with`` block.

    Args:
        camera: The camera.
        images: Depth in steps of its unit, each of shape (height, width).
    """

    def __init__(self, camera: SoftwareCamera, images: Sequence[NDArray[np.uint16]]) -> None:
        self._camera, self._images = camera, images
        self._stop, self.plugged = threading.Event(), threading.Event()
        self.plugged.set()
        self.pushed = 0
        """Images that the camera has seen."""
        self._thread = threading.Thread(target=self._run, name="software camera", daemon=True)

    def __enter__(self) -> SoftwareCameraFeed:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)

    def devices(self) -> list[Any]:
        """The devices that are connected: the camera, while `plugged` is set."""
        return [self._camera.device] if self.plugged.is_set() else []

    def _run(self) -> None:
        begin, number = time.perf_counter(), 0
        while not self._stop.is_set():
            wait = begin + number / self._camera.frames_per_second - time.perf_counter()
            if wait > 0 and self._stop.wait(wait):
                return
            if self.plugged.is_set():
                image = self._images[number % len(self._images)]
                self._camera.push(image, time=time.perf_counter(), number=number)
                self.pushed += 1
            number += 1
