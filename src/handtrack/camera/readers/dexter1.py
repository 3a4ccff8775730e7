"""Dexter 1 (Sridhar et al. 2013): one sequence of its time-of-flight camera.

Depth is 16-bit PNG in millimetres. Labels are six points a frame (five fingertips and the palm's
centre): pixels in Pos2D.txt, millimetres in Pos3D.txt. The position is taken from the pixel and the
depth alone, so that it agrees with the image whatever way the axes of Pos3D.txt point.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import FrameTruth
from handtrack.camera.png import read_png
from handtrack.camera.sequence import RecordedSequence, Subject, check_override, natural_key
from handtrack.errors import DamagedFileError, MissingFileError

CAMERA = Camera(width=320, height=240, fx=224.502, fy=230.494, cx=160.0, cy=120.0)
"""Factory values of the Creative camera; the data set tells none of its own."""
RATE = 25.0
"""Frame rate of the data set [1/s]."""
_POINTS = 6
_NO_DEPTH = 32000
"""Depth from which on the camera means "too near" or "too dark" [mm]."""


class SequenceDexter1(RecordedSequence):
    """The images of ``tof/depth``, and their labels if there are any."""

    format = "dexter1"
    layout = "folder of one sequence with tof/depth/*.png and, for labels, annotations/Pos2D.txt"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """The folder of a sequence, or its folder ``tof`` or ``tof/depth``."""
        return path.is_dir() and _images(path) is not None

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the folder; frames are read later, one by one."""
        images = _images(path)
        if images is None:
            raise MissingFileError(f"{path} holds no Dexter 1 images: expected {self.layout}")
        self._files = sorted(images.glob("*.png"), key=lambda file: natural_key(file.name))
        self._unit = np.float32(depth_unit or 1e-3)
        folder = images.parent.parent
        self._describe(
            name=folder.name,
            camera=check_override(camera, CAMERA, "the Dexter 1 data set"),
            frame_names=[file.name for file in self._files],
            frames_per_second=RATE,
        )
        self.subject = Subject(side="right")  # one actor's right hand in all sequences
        self._joints = self._read_labels(folder / "annotations")
        if self._joints is not None:
            self.truth = frozenset({"joints"})

    def _read_depth(self, index: int) -> NDArray[Any]:
        pixels = read_png(self._files[index], channels=1, bits=16)
        return np.where(pixels < _NO_DEPTH, pixels, 0).astype(np.float32) * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        if self._joints is None or index >= len(self._joints):
            return None
        return FrameTruth(joints=self._joints[index], joint_set="dexter6", side="right")

    def _read_labels(self, folder: Path) -> NDArray[np.float32] | None:
        """Labels [m], shape (nlabelled, 6, 3), camera frame; NaN where a point is not labelled."""
        files = folder / "Pos2D.txt", folder / "Pos3D.txt"
        if not all(file.is_file() for file in files):
            return None
        pixels, points = _read_table(files[0], 2), _read_table(files[1], 3)
        if len(pixels) != len(points):
            raise DamagedFileError(
                f"{files[0]} has {len(pixels)} frames and {files[1]} has {len(points)}"
            )
        z = np.abs(points[..., 2])
        z[(z == 0) | (z >= _NO_DEPTH)] = np.nan
        return self.camera.unproject(pixels, z * 1e-3).astype(np.float32)


def _images(path: Path) -> Path | None:
    """The folder ``tof/depth`` with at least one image."""
    path = path.resolve()
    for folder in (path / "tof" / "depth", path / "depth", path):
        named = folder.name == "depth" and folder.parent.name == "tof"
        if named and next(folder.glob("*.png"), None) is not None:
            return folder
    return None


def _read_table(path: Path, columns: int) -> NDArray[np.float64]:
    """Numbers of a label file, shape (nframe, 6, columns): a line per point, commas between."""
    try:
        values = np.array(path.read_text(encoding="ascii").replace(",", " ").split(), np.float64)
    except (OSError, ValueError) as error:
        raise DamagedFileError(f"{path} is not readable as numbers: {error}") from error
    if values.size % (_POINTS * columns):
        raise DamagedFileError(
            f"{path} holds {values.size} numbers: expected {_POINTS} x {columns} per frame"
        )
    return values.reshape(-1, _POINTS, columns)
