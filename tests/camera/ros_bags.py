"""Bags for tests: written with the library that defines them, damaged, opened without it."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from handtrack.camera.camera import Camera

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
COMPRESSED, KEY_VALUE = "sensor_msgs/msg/CompressedImage", "diagnostic_msgs/msg/KeyValue"
KINDS = ("rosbag1", "rosbag2", "rosbag2-mcap", "mcap")


class BagWriter:
    """One bag of any kind; messages are written in the order of the calls."""

    def __init__(self, folder: Path, kind: str, name: str = "bag") -> None:
        self.ros1 = kind == "rosbag1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self.path = folder / f"{name}.bag"
            self._writer: Any = Writer1(self.path)
        else:
            self.path = folder / name
            plugin = StoragePlugin.SQLITE3 if kind == "rosbag2" else StoragePlugin.MCAP
            self._writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self._kind = kind
        self._topics: dict[str, Any] = {}
        self._writer.open()

    def close(self) -> Path:
        self._writer.close()
        if self._kind == "mcap":
            (self.path,) = self.path.glob("*.mcap")
        return self.path

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, time: float) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", int(time), round(time % 1 * 1e9))
        values = (0, stamp, "camera") if self.ros1 else (stamp, "camera")
        return self.make("std_msgs/msg/Header", *values)

    def write(self, topic: str, kind: str, message: Any, bag_time: float) -> None:
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self._writer.write(self._topics[topic], round(bag_time * 1e9), pack(message, kind))

    def info(
        self, topic: str, camera: Camera, bag_time: float = 1.0, model: str = "plumb_bob"
    ) -> None:
        k = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0]
        p = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0]
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        message = self.make(
            INFO, self.header(bag_time), camera.height, camera.width, model, np.zeros(5),
            np.array(k), np.eye(3).ravel(), np.array(p), 0, 0, region,
        )  # fmt: skip
        self.write(topic, INFO, message, bag_time)

    def image(
        self, topic: str, pixels: np.ndarray, encoding: str, time: float, *, bag_time: float,
        padding: int = 0,
    ) -> None:  # fmt: skip
        height, width = pixels.shape[:2]
        lines = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        lines = np.pad(lines, ((0, 0), (0, padding)))
        message = self.make(
            IMAGE, self.header(time), height, width, encoding,
            int(pixels.dtype.byteorder == ">"), lines.shape[1], lines.ravel(),
        )  # fmt: skip
        self.write(topic, IMAGE, message, bag_time)

    def compressed(
        self, topic: str, pixels: np.ndarray, text: str, time: float, *, bag_time: float,
        scale: float = 0.0, shift: float = 0.0,
    ) -> None:  # fmt: skip
        png = cv2.imencode(".png", pixels)[1].tobytes()
        data = np.frombuffer(struct.pack("<iff", 0, scale, shift) + png, np.uint8)
        message = self.make(COMPRESSED, self.header(time), text, data)
        self.write(topic, COMPRESSED, message, bag_time)


def write_depth_bag(folder: Path, kind: str, camera: Camera, steps: np.ndarray) -> Path:
    """A bag as a camera's node writes it: depth in mm at 30 frames/s, and a colour image."""
    bag = BagWriter(folder, kind)
    bag.info("/camera/depth/camera_info", camera)
    bag.info("/camera/color/camera_info", camera.resize(32, 24))
    for number, image in enumerate(steps):
        time = 100.0 + number / 30
        bag.image("/camera/color/image_raw", np.zeros((24, 32, 3), np.uint8), "rgb8", time,
                  bag_time=1.5 + time)  # fmt: skip
        bag.image("/camera/depth/image_rect_raw", image, "16UC1", time, bag_time=1.5 + time)
    return bag.close()


def write_realsense_bag(path: Path, camera: Camera, steps: np.ndarray, unit: float) -> Path:
    """A .bag in the published layout of librealsense, version 4 (its ros_file_format.h)."""
    bag = BagWriter(path.parent, "rosbag1", path.stem)
    bag.store.register(get_types_from_msg(
        "uint32 fps\nstring encoding\nbool is_recommended\n", "realsense_msgs/msg/StreamInfo"
    ))  # fmt: skip
    device, sensor = "/device_0", "/device_0/sensor_0"
    stream = f"{sensor}/Depth_0"

    def put(topic: str, kind: str, *values: Any, bag_time: float = 1e-9) -> None:
        bag.write(topic, kind, bag.make(kind, *values), bag_time)

    # What does not change has the time 1 ns.
    put("/file_version", "std_msgs/msg/UInt32", 4)
    put(f"{device}/info", KEY_VALUE, "Name", "Test camera")
    put(f"{device}/info", KEY_VALUE, "Serial Number", "0123")
    put(f"{sensor}/info", KEY_VALUE, "Name", "Stereo Module")
    put(f"{sensor}/option/Depth Units/value", "std_msgs/msg/Float32", unit)
    put(f"{sensor}/option/Depth Units/description", "std_msgs/msg/String", "metres per step")
    put(f"{stream}/info", "realsense_msgs/msg/StreamInfo", 60, "mono16", True)
    bag.info(f"{stream}/info/camera_info", camera, 1e-9, model="None")
    translation = bag.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    rotation = bag.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    put(f"{stream}/tf/0", "geometry_msgs/msg/Transform", translation, rotation)
    for number, image in enumerate(steps):
        time, bag_time = 5 + number / 60, 0.01 + number / 60
        bag.image(f"{stream}/image/data", image, "mono16", time, bag_time=bag_time)
        for key, value in (
            ("timestamp_domain", "Hardware Clock"),
            ("Frame Counter", str(number)),
            ("Frame Timestamp", str(round(time * 1e6))),
        ):
            put(f"{stream}/image/metadata", KEY_VALUE, key, value, bag_time=bag_time)
    return bag.close()


DAMAGES = ("cut", "head", "middle")


def damaged(data: bytes, damage: str) -> bytes:
    """A file that was cut off, or with its head or its middle overwritten."""
    if damage == "cut":
        return data[: len(data) * 2 // 3]
    begin, wrong = (40, bytes(360)) if damage == "head" else (len(data) // 2, b"\xff" * 600)
    return data[:begin] + wrong + data[begin + len(wrong) :]


def told_without(package: str, *sources: str | Path) -> str:
    """What opening sources says where a package is not installed, a line each."""
    code = (
        "import sys; sys.modules[sys.argv[1]] = None\n"
        "from handtrack.camera.source import open_sequence\n"
        "from handtrack.errors import MissingDependencyError\n"
        "for source in sys.argv[2:]:\n"
        "    try:\n        open_sequence(source)\n"
        "    except MissingDependencyError as error:\n        print(error)\n"
    )
    words = [sys.executable, "-c", code, package, *map(str, sources)]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout
