"""MSRA Hand Gesture data set (Sun et al. 2015): one gesture folder, or one of its .bin files.

A .bin file is a header of six uint32 (image width, image height, left, top, right, bottom) and the
float32 depth [mm] of that window. Labels in joint.txt are millimetres with y up and z backward.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import FrameTruth
from handtrack.camera.sequence import RecordedSequence, Subject, check_override, natural_key
from handtrack.errors import DamagedFileError, MissingFileError

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)
"""Creative Interactive Gesture Camera of the data set."""
_NAME = re.compile(r"(\d+)_depth\.bin")
_HEADER = 24  # bytes

KEYPOINTS_FROM_MSRA = np.array([0, *range(17, 21), *range(1, 17)])
"""MSRA's joint (wrist, index, middle, ring, little, thumb) for each of the 21 keypoints."""


class SequenceMsra(RecordedSequence):
    """Frames ``000000_depth.bin`` and so on; keypoints if joint.txt is there."""

    format = "msra"
    layout = "folder with 000000_depth.bin ... and, for labels, joint.txt"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder or file named as in the data set whose header fits."""
        if path.is_file():
            return _NAME.fullmatch(path.name) is not None
        return any(_NAME.fullmatch(file.name) for file in path.glob("*_depth.bin"))

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the folder; frames are read later, one by one."""
        files = [path] if path.is_file() else list(path.glob("*_depth.bin"))
        self._files = sorted(
            (file for file in files if _NAME.fullmatch(file.name)),
            key=lambda file: natural_key(file.name),
        )
        if not self._files:
            raise MissingFileError(f"{path} holds no MSRA frames: expected {self.layout}")
        self._unit = np.float32(depth_unit or 1e-3)
        self._numbers = [int(file.name.split("_")[0]) for file in self._files]
        folder = path.resolve().parent if path.is_file() else path.resolve()
        self._describe(
            name=f"{folder.parent.name}_{folder.name}".lstrip("_"),
            camera=check_override(camera, CAMERA, "the MSRA data set"),
            frame_names=[file.name for file in self._files],
        )
        self.subject = Subject(side="right")  # all recordings of the data set
        labels = folder / "joint.txt"
        self._joints = _read_joints(labels) if labels.is_file() else None
        if self._joints is not None:
            self.truth = frozenset({"keypoints", "joints"})

    def _read_depth(self, index: int) -> NDArray[Any]:
        path = self._files[index]
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DamagedFileError(f"{path} cannot be read: {error}") from error
        if len(data) < _HEADER:
            raise DamagedFileError(f"{path} is truncated: {len(data)} bytes, its header has 24")
        width, height, left, top, right, bottom = map(int, np.frombuffer(data[:_HEADER], "<u4"))
        if (height, width) != self.camera.shape or not (
            0 <= left <= right <= width and 0 <= top <= bottom <= height
        ):
            raise DamagedFileError(
                f"{path} has an impossible header: image {width}x{height}, window {left} {top} "
                f"{right} {bottom}; expected a window in {self.camera.width}x{self.camera.height}"
            )
        expected = _HEADER + 4 * (right - left) * (bottom - top)
        if len(data) != expected:
            raise DamagedFileError(f"{path} has {len(data)} bytes: its header says {expected}")
        depth = np.zeros(self.camera.shape, np.float32)
        window = np.frombuffer(data, "<f4", offset=_HEADER).reshape(bottom - top, right - left)
        with np.errstate(over="ignore", invalid="ignore"):
            depth[top:bottom, left:right] = window * self._unit
        return depth

    def _read_truth(self, index: int) -> FrameTruth | None:
        row = self._numbers[index]
        if self._joints is None or row >= len(self._joints):
            return None
        joints = self._joints[row]
        return FrameTruth(
            keypoints=joints[KEYPOINTS_FROM_MSRA], joints=joints, joint_set="msra21", side="right"
        )


def _read_joints(path: Path) -> NDArray[np.float32]:
    """All labels [m], shape (nframe, 21, 3), camera frame, MSRA's order."""
    try:
        words = path.read_text(encoding="ascii").split()
        count = int(words[0])
        values = np.array(words[1:], np.float32)
    except (OSError, ValueError, IndexError) as error:
        raise DamagedFileError(
            f"{path} is not readable: expected the number of frames, then 63 numbers per line "
            f"({error})"
        ) from error
    if values.size != count * 63:
        raise DamagedFileError(f"{path} holds {values.size} numbers: expected {count} x 63")
    return values.reshape(count, 21, 3) * np.array([1e-3, -1e-3, -1e-3], np.float32)
