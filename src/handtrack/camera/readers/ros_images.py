"""Depth images and camera descriptions of ROS messages, in our terms.

Messages are those of sensor_msgs: Image, CompressedImage, CameraInfo. Depth is 16UC1 in millimetres
or 32FC1 in metres (REP 118); "compressedDepth" is a PNG behind a header of 12 bytes, as written by
compressed_depth_image_transport.
"""

from __future__ import annotations

import logging
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.png import decode_png
from handtrack.errors import DamagedFileError, InputError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings that can hold depth."""
_HEADER = struct.Struct("<iff")  # format of the config, and the two parameters of 32FC1
_logger = logging.getLogger(__name__)


def is_depth(message: Any, msgtype: str) -> bool:
    """Whether an image message holds what may be depth."""
    if msgtype == COMPRESSED:
        return "compresseddepth" in str(message.format).lower()
    return message.encoding in _TYPES


def encoding_of(message: Any, msgtype: str) -> str:
    """Encoding of an image message, in words."""
    return str(message.format if msgtype == COMPRESSED else message.encoding)


def depth_of(
    message: Any, msgtype: str, *, depth_unit: float | None, where: str
) -> NDArray[np.float32]:
    """Depth of an image message [m], shape (height, width).

    Args:
        message: The message.
        msgtype: Its type, `IMAGE` or `COMPRESSED`.
        depth_unit: One step of an integer image [m]; None takes millimetres.
        where: What the message is, for errors.

    Raises:
        DamagedFileError: The image is not depth, or its bytes do not fit what it says.
    """
    if msgtype == COMPRESSED:
        return _decompressed(message, depth_unit or 1e-3, where)
    if message.encoding not in _TYPES:
        raise DamagedFileError(
            f"{where} is {message.encoding}: expected depth as {', '.join(_TYPES)}"
        )
    kind = np.dtype(_TYPES[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8).ravel()
    if not (height and width and step >= width * kind.itemsize and data.size >= height * step):
        raise DamagedFileError(
            f"{where} has {data.size} bytes: its header says {width}x{height} {message.encoding} "
            f"in lines of {step} bytes"
        )
    lines = data[: height * step].reshape(height, step)[:, : width * kind.itemsize]
    pixels = np.ascontiguousarray(lines).view(kind)
    unit = 1.0 if kind.kind == "f" else depth_unit or 1e-3
    return pixels.astype(np.float32) * np.float32(unit)


def camera_of(message: Any, *, rectified: bool, where: str) -> Camera:
    """Camera of a CameraInfo message.

    Args:
        message: The message, of ROS 1 or ROS 2.
        rectified: Whether the image was rectified, so that the matrix P holds instead of K.
        where: What the message is, for errors.

    Raises:
        InputError: It describes no camera, as the all-zero message of an uncalibrated one.
    """
    # ROS 1 writes the fields in capitals.
    raw, projection, distortion = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), np.float64)
        for name in ("k", "p", "d")
    )
    matrix = raw.reshape(3, 3) if raw.size == 9 else np.zeros((3, 3))
    if rectified and projection.size == 12 and projection[0] > 0:
        matrix = projection.reshape(3, 4)[:, :3]
    elif not rectified and np.abs(distortion).sum() > 1e-6:
        _logger.warning(
            "%s has lens distortion, which is not corrected: rectify the depth first", where
        )
    try:
        return Camera(
            width=int(message.width), height=int(message.height), fx=matrix[0, 0],
            fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2],
        )  # fmt: skip
    except InputError as error:
        raise InputError(f"{where} describes no camera ({error}): give one with camera=") from None


def stamp_of(message: Any) -> float:
    """Time in a message's header [s]; 0 where none was set."""
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _decompressed(message: Any, unit: float, where: str) -> NDArray[np.float32]:
    """Depth of a compressedDepth message [m]."""
    text = str(message.format)
    data = np.asarray(message.data, np.uint8).tobytes()
    if "rvl" in text.lower():
        raise DamagedFileError(f"{where} is RVL-compressed depth: only PNG can be read")
    if len(data) < _HEADER.size:
        raise DamagedFileError(f"{where} is truncated: {len(data)} bytes")
    _, scale, shift = _HEADER.unpack_from(data)
    pixels = decode_png(data[_HEADER.size :], where, channels=1, bits=16).astype(np.float32)
    if not text.startswith("32FC1"):
        return pixels * np.float32(unit)
    # Quantised inverse depth: pixel = scale / depth + shift; 0 = no measurement.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(pixels > 0, np.float32(scale) / (pixels - np.float32(shift)), 0).astype(
            np.float32
        )
