"""A RealSense depth camera as a live source, through librealsense's sensors.

Only the depth sensor is opened, so no colour is paid for and frames need not wait for each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from handtrack.camera.live import LiveImage, LiveInfo
from handtrack.camera.readers.realsense_profile import camera_of, depth_sensor_of, depth_unit_of
from handtrack.errors import DeviceError
from handtrack.optional import import_extra

PREFERRED_SIZE = (640, 480)
"""Width and height that are taken where the camera offers them [pixels]."""
PREFERRED_RATE = 60
"""Frame rate that is taken where the camera offers it [1/s]."""


class RealSenseDriver:
    """Live source for a RealSense camera.

    Args:
        serial: Serial number; empty takes the first camera found.
        find: Gives the devices to choose from; None asks librealsense for those connected.
    """

    def __init__(self, serial: str = "", *, find: Callable[[], list[Any]] | None = None) -> None:
        self._rs = import_extra("pyrealsense2", "realsense", "a RealSense camera")
        self._serial, self._find = serial, find or self._connected
        self._context: Any = None
        self._device: Any = None
        self._sensor: Any = None
        self._queue: Any = None
        self._unit = 0.001

    def open(self) -> LiveInfo:
        """Find the camera and start its depth stream.

        Raises:
            DeviceError: There is no such camera, or it does not start.
        """
        rs = self._rs
        device = self._choose()
        name, serial = self._told(device)
        try:
            sensor = depth_sensor_of(rs, device)
            profile = _best_profile(rs, sensor)
            camera = camera_of(profile)
            # Capacity 1: what is not taken in time is replaced by what is newer.
            queue = rs.frame_queue(1)
            sensor.open(profile)
            # Kept at once, so that a failing start is undone by `close`.
            self._device, self._sensor, self._queue = device, sensor, queue
            sensor.start(queue)
            self._unit = depth_unit_of(rs, sensor)
        except RuntimeError as error:
            raise DeviceError(f"{name} {serial} does not start: {error}") from error
        self._serial = serial  # after reconnecting it must be the same one
        return LiveInfo(
            name=f"{name} {serial}", camera=camera, frames_per_second=float(profile.fps())
        )

    def read(self, timeout: float) -> LiveImage | None:
        """Next image.

        Raises:
            DeviceError: The camera is not connected any more.
        """
        if self._queue is None:
            raise DeviceError("the camera is not open")
        try:
            there, frame = self._queue.try_wait_for_frame(int(1e3 * timeout))
            if there:
                return LiveImage(
                    np.array(frame.get_data()), self._unit, 1e-3 * frame.get_timestamp(),
                    int(frame.get_frame_number()),
                )  # fmt: skip
            connected = self._device.is_connected()
        except RuntimeError as error:
            raise DeviceError(f"camera {self._serial} failed: {error}") from error
        if not connected:
            raise DeviceError(f"camera {self._serial} was unplugged")
        return None

    def close(self) -> None:
        """Stop the stream; a camera that is gone already is let go."""
        sensor, self._sensor = self._sensor, None
        self._queue = self._device = None
        if sensor is None:
            return
        for stop in (sensor.stop, sensor.close):
            try:
                stop()
            except RuntimeError:  # gone, or not started
                continue

    def _connected(self) -> list[Any]:
        """Cameras that librealsense sees."""
        if self._context is None:
            self._context = self._rs.context()
        return list(self._context.query_devices())

    def _choose(self) -> Any:
        """The camera with the wanted serial number, or the first."""
        try:
            devices = [device for device in self._find() if device is not None]
            told = [self._told(device) for device in devices]
        except RuntimeError as error:
            raise DeviceError(f"librealsense cannot list cameras: {error}") from error
        for device, (_, serial) in zip(devices, told, strict=True):
            if not self._serial or serial == self._serial:
                return device
        wanted = f"with serial number {self._serial}" if self._serial else "connected"
        there = ", ".join(f"{name} {serial}" for name, serial in told) or "none"
        raise DeviceError(
            f"no RealSense camera {wanted} (found: {there}): plug it in, or see that no other "
            "program holds it"
        )

    def _told(self, device: Any) -> tuple[str, str]:
        """Name and serial number of a device."""
        info = self._rs.camera_info
        name, serial = (
            device.get_info(kind) if device.supports(kind) else "unknown"
            for kind in (info.name, info.serial_number)
        )
        return name, serial


def _best_profile(rs: Any, sensor: Any) -> Any:
    """The depth stream of the preferred size, else the nearest, at the rate next to the wanted."""
    profiles = [
        profile.as_video_stream_profile()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
    ]
    if not profiles:
        raise DeviceError("the camera offers no 16-bit depth stream")

    def merit(profile: Any) -> tuple[float, int]:
        size = profile.width() * profile.height() / (PREFERRED_SIZE[0] * PREFERRED_SIZE[1])
        exact = (profile.width(), profile.height()) == PREFERRED_SIZE
        return (0.0 if exact else -1.0 - abs(math.log(size))), -abs(profile.fps() - PREFERRED_RATE)

    return max(profiles, key=merit)
