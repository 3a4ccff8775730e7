"""Recordings of librealsense, played back by librealsense: .db3, and .bag of older versions.

Both are ROS bags with topics of librealsense's own. A playback has no index, so its frames are
listed once on opening; a frame out of order is found by playing again from shortly before it.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.readers.bag_check import check_bag
from handtrack.camera.readers.realsense_profile import camera_of, depth_sensor_of, depth_unit_of
from handtrack.camera.readers.rosbag import ROS1_MAGIC, SQLITE_MAGIC, one_line, sqlite_topics
from handtrack.camera.sequence import RecordedSequence, check_override
from handtrack.errors import DamagedFileError, DeviceError, HandtrackError, InputError
from handtrack.files import starts_with
from handtrack.optional import import_extra

_TOPIC = "/device_0/"
"""How librealsense's topics start."""
_INDEX_BYTES = 2**18
"""So much of a .bag's index is searched for such a topic [bytes]."""
_LAST_FRAMES = 0.2
"""Wait for frames that are still on their way when the playback says that it stopped [s]."""
_PATIENCE = 10.0
"""A playback that gives nothing for so long is damaged [s]."""


class SequenceRealSense(RecordedSequence):
    """The depth stream of a recording, in order of its frames."""

    format = "realsense"
    layout = "recording of librealsense (.db3, or .bag of older versions) with a depth stream"
    extra = "realsense"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A bag with librealsense's topics."""
        if not path.is_file():
            return False
        if starts_with(path, SQLITE_MAGIC):
            return any(topic.startswith(_TOPIC) for topic in sqlite_topics(path))
        return starts_with(path, ROS1_MAGIC) and _TOPIC.encode() in _bag_index(path)

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the recording and list its frames, which plays it once as fast as possible."""
        self._rs = import_extra("pyrealsense2", "realsense", f"reading {path}")
        if starts_with(path, ROS1_MAGIC):
            check_bag(path)
        self._path = path
        self._player: _Player | None = None
        self._next = -1
        try:
            self._player = _Player(self._rs, path)
            own, unit, rate = self._player.camera, self._player.unit, self._player.rate
            self._shots = [shot.without_pixels() for shot in self._player]
        except HandtrackError:
            raise
        except RuntimeError as error:
            raise DamagedFileError(f"{path} cannot be played: {one_line(error)}") from error
        finally:
            self.close()
        if not self._shots:
            raise InputError(f"{path} holds no depth frame")
        self._unit = np.float32(depth_unit or unit)
        times = np.array([shot.time for shot in self._shots])
        self._describe(
            name=path.stem,
            camera=check_override(camera, own, str(path)),
            frame_names=[f"depth[{shot.number}]" for shot in self._shots],
            frames_per_second=rate,
            times=times if (np.diff(times) >= 0).all() else None,
        )

    def close(self) -> None:
        """Stop playing."""
        player, self._player = self._player, None
        if player is not None:
            player.close()

    def _read_depth(self, index: int) -> NDArray[Any]:
        playing = self._player is not None and index == self._next
        self._next = -1  # for the case that reading fails
        try:
            pixels = self._following(index) if playing else self._found(index)
        except RuntimeError as error:
            raise DamagedFileError(
                f"{self.frame_names[index]} of {self._path} cannot be played: {one_line(error)}"
            ) from error
        if pixels is None:
            raise DamagedFileError(f"{self._path} does not give {self.frame_names[index]} again")
        self._next = index + 1
        return pixels.astype(np.float32) * self._unit

    def _found(self, index: int) -> NDArray[Any] | None:
        """Pixels of any frame: played anew from before it, from the start if that fails."""
        for seek in (True, False):
            self.close()
            self._player = _Player(self._rs, self._path)
            if seek:
                self._player.seek(self._shots[index].position)
            pixels = self._following(index)
            if pixels is not None:
                return pixels
        return None

    def _following(self, index: int) -> NDArray[Any] | None:
        """Pixels of a frame that is still to come; None when it does not."""
        assert self._player is not None
        wanted = self._shots[index]
        for shot in self._player:
            if (shot.number, shot.time) == (wanted.number, wanted.time):
                return shot.pixels
        return None


@dataclass(frozen=True, slots=True)
class _Shot:
    """One frame of a playback."""

    number: int
    time: float  # by the sensor [s]
    position: int  # in the file [ns]
    pixels: NDArray[Any] | None

    def without_pixels(self) -> _Shot:
        return _Shot(self.number, self.time, self.position, None)


class _Player:
    """A recording that plays: iterating gives every frame of its depth stream.

    librealsense pushes frames from a thread of its own, and in a playback that is not in real time
    it waits for the receiver; so none is lost while the box of one frame is full.
    """

    def __init__(self, rs: Any, path: Path) -> None:
        self._box: queue.Queue[_Shot] = queue.Queue(1)
        self._stop, self._ended = threading.Event(), threading.Event()
        self._stopped_status = rs.playback_status.stopped
        # The context must outlive the device.
        self._context = rs.context()
        self._playback = self._context.load_device(str(path))
        self._playback.set_real_time(False)
        self._playback.set_status_changed_callback(self._on_status)
        try:
            self._sensor = depth_sensor_of(rs, self._playback)
        except DeviceError:
            raise InputError(f"{path} has no depth stream") from None
        profile = next(
            profile
            for profile in self._sensor.get_stream_profiles()
            if profile.stream_type() == rs.stream.depth
        )
        self.camera, self.rate = camera_of(profile), float(profile.fps())
        self.unit = depth_unit_of(rs, self._sensor)
        self._sensor.open(profile)
        self._sensor.start(self._on_frame)

    def seek(self, position: int) -> None:
        """Go on from shortly before a position in the file [ns]; frames on their way still come."""
        self._playback.seek(timedelta(microseconds=max(0, position // 1000 - 1)))

    def __iter__(self) -> _Player:
        return self

    def __next__(self) -> _Shot:
        waited = 0.0
        while waited < _PATIENCE:
            ended = self._ended.is_set()
            try:
                return self._box.get(timeout=_LAST_FRAMES)
            except queue.Empty:
                if ended:
                    raise StopIteration from None
                waited += _LAST_FRAMES
        raise RuntimeError(f"no frame came within {_PATIENCE:g} s")

    def close(self) -> None:
        """Stop; frames that are on their way are dropped."""
        self._stop.set()
        for stop in (self._sensor.stop, self._sensor.close):
            with contextlib.suppress(RuntimeError):
                stop()

    def _on_frame(self, frame: Any) -> None:
        shot = _Shot(
            int(frame.get_frame_number()), 1e-3 * frame.get_timestamp(),
            int(self._playback.get_position()), np.array(frame.get_data()),
        )  # fmt: skip
        while not self._stop.is_set():
            with contextlib.suppress(queue.Full):
                self._box.put(shot, timeout=0.05)
                return

    def _on_status(self, status: Any) -> None:
        if status == self._stopped_status:
            self._ended.set()


def _bag_index(path: Path) -> bytes:
    """Start of a bag's index, which lists its topics; of the bag itself if it has no index."""
    with path.open("rb") as file:
        start = file.read(4096)
        place = start.find(b"index_pos=")
        position = int.from_bytes(start[place + 10 : place + 18], "little") if place > 0 else 0
        file.seek(position if 0 < position < path.stat().st_size else 0)
        return file.read(_INDEX_BYTES)
