"""Bags of ROS 1 and ROS 2 and MCAP files with a depth image topic, through `rosbags`."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.readers import ros_images
from handtrack.camera.sequence import RecordedSequence, check_override
from handtrack.errors import DamagedFileError, HandtrackError, InputError
from handtrack.files import starts_with
from handtrack.optional import import_extra

ROS1_MAGIC = b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"


class SequenceBag(RecordedSequence):
    """Depth images of one topic; frames are stamped with the time in their headers."""

    extra = "rosbag"
    has_topics = True
    suffixes: ClassVar[tuple[str, ...]]
    """What the name of a file must end with: `rosbags` goes by it."""

    def __init__(
        self,
        path: Path,
        *,
        camera: Camera | None = None,
        depth_unit: float | None = None,
        topic: str | None = None,
    ) -> None:
        """Open the bag, find the depth topic and its camera, and list its messages."""
        highlevel = import_extra("rosbags.highlevel", "rosbag", f"reading {path}")
        if path.is_file() and path.suffix not in self.suffixes:
            raise InputError(
                f"{path} is a {self.format} file: its name must end with "
                f"{' or '.join(self.suffixes)}; rename it"
            )
        self._path, self._unit = path, depth_unit
        self._closing = contextlib.ExitStack()
        try:
            self._bag = self._closing.enter_context(_opened(highlevel, path))
            self._depth = self._choose(topic)
            self._index, stamps = self._list()
            own = self._camera(camera)
        except HandtrackError:
            self.close()
            raise
        except Exception as error:  # what damaged bags raise in `rosbags` is not told
            self.close()
            raise _damaged(path, error) from error
        self._messages: Iterator[Any] = iter(())
        self._next = -1
        self._describe(
            name=path.stem if path.is_file() else path.resolve().name,
            camera=own,
            frame_names=[f"{self._depth.topic}[{place}]" for place in range(len(self._index))],
            times=stamps,
            frames_per_second=_rate(stamps),
        )

    def close(self) -> None:
        """Close the bag."""
        self._messages = iter(())
        self._next = -1
        with contextlib.suppress(Exception):  # a bag may be too damaged to be closed
            self._closing.close()

    def _read_depth(self, index: int) -> NDArray[Any]:
        where = f"{self.frame_names[index]} of {self._path}"
        try:
            message = self._message(index)
            return ros_images.depth_of(
                message, self._depth.msgtype, depth_unit=self._unit, where=where
            )
        except HandtrackError:
            raise
        except Exception as error:
            raise _damaged(Path(where), error) from error

    def _message(self, index: int) -> Any:
        """A message of the depth topic; one after the other is quickest."""
        if index != self._next:
            self._next = -1
            begin, rank = self._index[index]
            self._messages = self._bag.messages([self._depth], start=begin)
            for _ in range(rank):  # others of the very same time
                next(self._messages)
        self._next = -1  # for the case that reading fails
        _, _, data = next(self._messages)
        self._next = index + 1
        return self._bag.deserialize(data, self._depth.msgtype)

    def _choose(self, topic: str | None) -> Any:
        """The connection of the depth topic.

        Raises:
            InputError: There is none, or several; the message lists them.
        """
        images = [
            connection for connection in self._bag.connections
            if connection.msgtype in (ros_images.IMAGE, ros_images.COMPRESSED)
        ]  # fmt: skip
        if topic is not None:
            for connection in images:
                if connection.topic == topic:
                    return connection
            raise InputError(f"{self._path} has no image topic {topic!r}: {self._told(images)}")
        depth = [connection for connection in images if self._holds_depth(connection)]
        raw = {connection.topic for connection in depth if connection.msgtype == ros_images.IMAGE}
        # The compressed form of an image that is there in full tells nothing new.
        depth = [
            connection for connection in depth
            if connection.topic in raw or _base(connection.topic) not in raw
        ]  # fmt: skip
        if len({connection.topic for connection in depth}) == 1:
            return depth[0]
        if not depth:
            raise InputError(
                f"{self._path} has no depth image (16UC1, mono16, 32FC1 or compressedDepth): "
                f"{self._told(images)}"
            )
        raise InputError(
            f"{self._path} has {len(depth)} depth topics: choose one with topic= (--topic): "
            f"{', '.join(sorted(connection.topic for connection in depth))}"
        )

    def _holds_depth(self, connection: Any) -> bool:
        """Whether the first image of a topic may be depth."""
        message = self._first(connection)
        return message is not None and ros_images.is_depth(message, connection.msgtype)

    def _first(self, connection: Any) -> Any:
        """First message of a connection, None without one."""
        for _, _, data in self._bag.messages([connection]):
            return self._bag.deserialize(data, connection.msgtype)
        return None

    def _told(self, images: list[Any]) -> str:
        """The image topics with their encodings, else all topics, in words."""
        if images:
            told = []
            for connection in images:
                first = self._first(connection)
                kind = "empty" if first is None else ros_images.encoding_of(
                    first, connection.msgtype
                )  # fmt: skip
                told.append(f"{connection.topic} ({kind})")
            return f"its images are {', '.join(sorted(told))}"
        topics = sorted(f"{c.topic} ({c.msgtype})" for c in self._bag.connections)
        return f"its topics are {', '.join(topics[:12]) or 'none'}"

    def _list(self) -> tuple[list[tuple[int, int]], NDArray[np.float64]]:
        """Bag time [ns] and rank among equal times of each image, and time stamps [s]."""
        index: list[tuple[int, int]] = []
        stamps: list[float] = []
        for _, time, data in self._bag.messages([self._depth]):
            rank = index[-1][1] + 1 if index and index[-1][0] == time else 0
            index.append((time, rank))
            try:
                stamps.append(ros_images.stamp_of(self._bag.deserialize(data, self._depth.msgtype)))
            except Exception:  # the frame itself will say what is wrong when it is read
                stamps.append(0.0)
        if not index:
            raise InputError(f"{self._path}: the topic {self._depth.topic} holds no image")
        times = np.array(stamps)
        if not (times > 0).all() or (np.diff(times) < 0).any():
            times = np.array([time for time, _ in index]) * 1e-9
        return index, times

    def _camera(self, given: Camera | None) -> Camera:
        """The camera of the depth topic.

        Raises:
            InputError: No CameraInfo belongs to it and none was given.
        """
        first = self._first(self._depth)
        where = f"{self._depth.topic} of {self._path}"
        height, width = ros_images.depth_of(
            first, self._depth.msgtype, depth_unit=self._unit, where=where
        ).shape
        image = _base(self._depth.topic) if self._depth.msgtype == ros_images.COMPRESSED else (
            self._depth.topic
        )  # fmt: skip
        infos = {
            connection.topic: connection for connection in self._bag.connections
            if connection.msgtype == ros_images.CAMERA_INFO
        }  # fmt: skip
        sibling = f"{_base(image)}/camera_info"
        fitting: dict[str, Camera] = {}
        for name in [sibling] if sibling in infos else infos:
            message = self._first(infos[name])
            if message is not None and (message.height, message.width) == (height, width):
                rectified = "rect" in image.rsplit("/", 1)[-1]
                fitting[name] = ros_images.camera_of(
                    message, rectified=rectified, where=f"{name} of {self._path}"
                )
        if len(set(fitting.values())) == 1:
            return check_override(given, next(iter(fitting.values())), where)
        if given is not None:
            if given.shape != (height, width):
                raise InputError(
                    f"the camera given is {given.width}x{given.height}: {where} is {width}x{height}"
                )
            return given
        there = ", ".join(sorted(fitting or infos)) or "none"
        raise InputError(
            f"{where} has no camera of its own ({sibling}, {width}x{height}; CameraInfo topics: "
            f"{there}): give one with camera="
        )


class SequenceRosbag1(SequenceBag):
    """A bag of ROS 1, version 2.0."""

    format = "rosbag1"
    layout = "ROS 1 bag (.bag) with a depth image topic and its camera_info"
    suffixes = (".bag",)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A file that starts as a bag of ROS 1 does."""
        return path.is_file() and starts_with(path, ROS1_MAGIC)


class SequenceRosbag2(SequenceBag):
    """A bag of ROS 2: the folder with metadata.yaml, or one of its .db3 files."""

    format = "rosbag2"
    layout = "ROS 2 bag: folder with metadata.yaml, or .db3 file; depth image topic, camera_info"
    suffixes = (".db3",)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """The folder of a bag, or an SQLite file with messages."""
        if path.is_file():
            return starts_with(path, SQLITE_MAGIC) and (
                path.suffix == ".db3" or bool(sqlite_topics(path))
            )
        try:
            return "rosbag2_bagfile_information" in (path / "metadata.yaml").read_text("utf-8")
        except (OSError, ValueError):
            return False


class SequenceMcap(SequenceBag):
    """An MCAP file with messages of ROS 2."""

    format = "mcap"
    layout = "MCAP file (.mcap) of ROS 2 messages with a depth image topic and its camera_info"
    suffixes = (".mcap",)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A file that starts as MCAP does."""
        return path.is_file() and starts_with(path, MCAP_MAGIC)


def sqlite_topics(path: Path) -> list[str]:
    """Names of the topics in an SQLite bag; none where it is no bag or is damaged."""
    try:
        with contextlib.closing(
            sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        ) as base:
            return [str(name) for (name,) in base.execute("SELECT name FROM topics")]
    except sqlite3.Error:
        return []


def _opened(highlevel: Any, path: Path) -> Any:
    """The bag, with the standard messages for those that carry no definitions."""
    typesys = import_extra("rosbags.typesys", "rosbag", f"reading {path}")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    return highlevel.AnyReader([path], default_typestore=store)


def _base(topic: str) -> str:
    """The topic without its last part."""
    return topic.rsplit("/", 1)[0]


def _rate(times: NDArray[np.float64]) -> float | None:
    """Frame rate by the median step [1/s]; None where it cannot be told."""
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else 0.0
    return round(1.0 / step, 3) if step > 1e-4 else None


def one_line(error: Exception) -> str:
    """What an error of a library says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _damaged(path: Path, error: Exception) -> DamagedFileError:
    """What to say of a bag that `rosbags` cannot read, in one line."""
    reason = one_line(error)
    if "not indexed" in reason:
        reason += " (rosbag reindex repairs a bag whose recording was cut off)"
    return DamagedFileError(f"{path} cannot be read: {reason}")
