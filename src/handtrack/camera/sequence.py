"""What a source of depth frames is: the interface of recordings and live cameras alike."""

from __future__ import annotations

import operator
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from collections.abc import Sequence as _Indices
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame, FrameTruth, check_depth
from handtrack.errors import DamagedFileError, InputError, MissingFileError

ASSUMED_RATE = 30.0
"""Frames per second by which frames are stamped when a recording does not tell its rate [1/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """Whose hand a recording shows, as far as it is known."""

    side: str | None = None
    """"right" or "left", None when it is not told."""
    alpha: NDArray[np.float64] | None = None
    """Bone-scale coefficients of the hand shape, shape (nalpha,)."""
    beta: NDArray[np.float64] | None = None
    """Surface coefficients of the hand shape, shape (nbeta,)."""
    scale: float | None = None
    """Overall factor on the hand's size."""


class Sequence(ABC):
    """Depth frames in order of time: iterate over it, inside a ``with`` block.

    A frame that cannot be read does not end the iteration: it comes with an all-zero depth and the
    reason in `DepthFrame.problem`, so that tracking goes on with the next one.
    """

    name: str
    """Name of the recording or device."""
    camera: Camera
    """Intrinsics of every frame."""
    frames_per_second: float | None = None
    """Frame rate [1/s], None when it is not known."""
    subject: Subject | None = None
    """Whose hand it is, None when nothing is known."""
    truth: frozenset[str] = frozenset()
    """Fields of `FrameTruth` that frames may carry: "keypoints", "pose", "joints"."""

    @property
    def live(self) -> bool:
        """Whether frames come from a device as time passes; old ones are lost then."""
        return False

    @property
    def dropped(self) -> int:
        """Frames that were lost because newer ones were there; always 0 in a recording."""
        return 0

    @property
    def status(self) -> str:
        """What the source is doing: "recorded", or one of `live.LIVE_STATUSES`."""
        return "recorded"

    @abstractmethod
    def __iter__(self) -> Iterator[DepthFrame]: ...

    def close(self) -> None:  # noqa: B027 (most sources hold nothing open)
        """Release files and devices; the sequence cannot be read afterwards."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RecordedSequence(Sequence):
    """Frames on disk: its length is known and any frame can be read, one at a time.

    A reader derives from this class, sets `format` and `layout`, and implements `recognises`,
    the constructor and `_read_depth`; docs/formats.md and CONTRIBUTING.md say more.
    """

    format: ClassVar[str]
    """Name of the format, as given to `open_sequence`."""
    layout: ClassVar[str]
    """What the format looks like on disk, one line."""
    extra: ClassVar[str | None] = None
    """Extra of this distribution that reading it needs, a key of `optional.EXTRAS`."""
    has_topics: ClassVar[bool] = False
    """Whether a file may hold several image streams; the constructor takes `topic` then."""

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a path that exists holds this format, judged by its content."""

    @abstractmethod
    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None: ...

    def _describe(
        self,
        *,
        name: str,
        camera: Camera,
        frame_names: _Indices[str],
        frames_per_second: float | None = None,
        times: NDArray[np.float64] | None = None,
    ) -> None:
        """Set what every recording has; called by the constructors of the readers."""
        self.name, self.camera, self.frames_per_second = name, camera, frames_per_second
        self.frame_names = frame_names
        if times is None:
            times = np.arange(len(frame_names)) / (frames_per_second or ASSUMED_RATE)
        self.times = times
        """Time stamp of each frame [s], shape (nframe,)."""

    @abstractmethod
    def _read_depth(self, index: int) -> NDArray[Any]:
        """Depth of one frame [m], shape (height, width), any float type.

        Raises:
            DamagedFileError: The frame cannot be read; the message names the file.
        """

    def _read_truth(self, index: int) -> FrameTruth | None:
        """Labels of one frame."""
        del index
        return None

    def read(self, index: SupportsIndex) -> DepthFrame:
        """Read one frame.

        Raises:
            IndexError: There is no such frame.
            DamagedFileError: The frame cannot be read; the message names the file.
        """
        index = self._position(index)
        depth = self._read_depth(index)
        if depth.shape != self.camera.shape:
            raise DamagedFileError(
                f"{self.frame_names[index]} of {self.name} is {_size(depth.shape)}: its camera "
                f"says {_size(self.camera.shape)}"
            )
        clean, _ = check_depth(depth, self.camera)
        return self._frame(index, clean, None)

    def __getitem__(self, index: SupportsIndex) -> DepthFrame:
        """Read one frame; one that cannot be read is all zero and says why in `problem`."""
        index = self._position(index)
        try:
            return self.read(index)
        except (DamagedFileError, MissingFileError, OSError) as error:
            return self._frame(index, np.zeros(self.camera.shape, np.float32), str(error))

    def __len__(self) -> int:
        return len(self.frame_names)

    def __iter__(self) -> Iterator[DepthFrame]:
        for index in range(len(self)):
            yield self[index]

    def _position(self, index: SupportsIndex) -> int:
        """The index counted from the front, checked."""
        number = operator.index(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"frame {number} of {self.name}: it has {len(self)} frames")
        return number % len(self)

    def _frame(self, index: int, depth: NDArray[np.float32], problem: str | None) -> DepthFrame:
        """A frame with everything but its depth filled in."""
        return DepthFrame(
            depth=depth,
            camera=self.camera,
            time=float(self.times[index]),
            index=index,
            name=self.frame_names[index],
            truth=self._read_truth(index),
            problem=problem,
        )


def check_override(camera: Camera | None, default: Camera, where: str) -> Camera:
    """The camera given by the caller if there is one, else the format's own.

    Raises:
        InputError: The caller's camera has another image size than the recording.
    """
    if camera is None:
        return default
    if camera.shape != default.shape:
        raise InputError(
            f"the camera given is {_size(camera.shape)}: {where} is {_size(default.shape)}; "
            "use Camera.resize or Camera.crop to adapt the intrinsics"
        )
    return camera


def check_times(times: Any, count: int, where: str) -> NDArray[np.float64]:
    """Time stamps [s], shape (count,), checked to be finite and not to run backwards."""
    try:
        array = np.asarray(times, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (count,) or not np.isfinite(array).all() or (np.diff(array) < 0).any():
        raise InputError(
            f"{where} has unusable time stamps: expected {count} finite numbers of seconds, one "
            f"per frame, not decreasing; got shape {array.shape}"
        )
    return array


def check_unit(value: Any, where: str) -> float:
    """A depth unit [m], checked to be a positive number that can be one."""
    if isinstance(value, (int, float, np.number)) and 0 < value <= 1:
        return float(value)
    raise InputError(
        f"depth_unit_m in {where} is {value!r}: expected how many metres one step of the "
        "integer depth is, such as 0.001 for millimetres"
    )


def natural_key(name: str) -> tuple[str | int, ...]:
    """Key that sorts frame 2 before frame 10."""
    # Splitting by a group alternates text and digits, so keys always compare like with like.
    parts = re.split("([0-9]+)", name)
    return tuple(int(part) if place % 2 else part for place, part in enumerate(parts))


def _size(shape: tuple[int, ...]) -> str:
    """Image size in words."""
    return "x".join(map(str, shape[::-1]))
