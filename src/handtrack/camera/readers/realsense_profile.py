"""What librealsense says about a depth stream, in our terms; for live cameras and recordings."""

from __future__ import annotations

from typing import Any

import numpy as np

from handtrack.camera.camera import Camera
from handtrack.errors import DeviceError


def depth_sensor_of(rs: Any, device: Any) -> Any:
    """The device's sensor that streams depth.

    Raises:
        DeviceError: There is none.
    """
    for sensor in device.query_sensors():
        if any(
            profile.stream_type() == rs.stream.depth for profile in sensor.get_stream_profiles()
        ):
            return sensor
    raise DeviceError("the device has no depth sensor")


def camera_of(profile: Any) -> Camera:
    """Intrinsics of a depth stream; integer pixel coordinates are centres there, too."""
    lens = profile.as_video_stream_profile().get_intrinsics()
    return Camera(
        width=lens.width, height=lens.height, fx=_shortest(lens.fx), fy=_shortest(lens.fy),
        cx=_shortest(lens.ppx), cy=_shortest(lens.ppy),
    )  # fmt: skip


def depth_unit_of(rs: Any, sensor: Any) -> float:
    """What one step of a sensor's depth is [m]; librealsense says millimetres where it is mute."""
    if not sensor.supports(rs.option.depth_units):
        return 0.001
    return _shortest(sensor.get_option(rs.option.depth_units))


def _shortest(value: float) -> float:
    """The number that somebody meant who stored it as float32: 0.1, not 0.10000000149."""
    return float(str(np.float32(value)))
