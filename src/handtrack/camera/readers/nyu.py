"""NYU Hand Pose data set (Tompson et al. 2014): test or train folder, first camera.

Depth is packed into colour PNGs: millimetres = green * 256 + blue. Labels in joint_data.mat are
millimetres with y up, so y changes its sign.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import FrameTruth
from handtrack.camera.png import read_png
from handtrack.camera.sequence import RecordedSequence, check_override
from handtrack.errors import DamagedFileError, MissingFileError

CAMERA = Camera(width=640, height=480, fx=588.03, fy=587.07, cx=320.0, cy=240.0)
"""PrimeSense camera of the data set."""
_NAME = re.compile(r"depth_1_(\d+)\.png")


class SequenceNyu(RecordedSequence):
    """Frames ``depth_1_0000001.png`` and so on; labels "nyu36" if joint_data.mat is there."""

    format = "nyu"
    layout = "folder with depth_1_0000001.png ... and, for labels, joint_data.mat"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A folder with images named as in the data set."""
        return path.is_dir() and any(_NAME.fullmatch(p.name) for p in path.glob("depth_1_*.png"))

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the folder; frames are read later, one by one."""
        found = [(m, p) for p in path.glob("depth_1_*.png") if (m := _NAME.fullmatch(p.name))]
        if not found:
            raise MissingFileError(f"{path} holds no NYU images: expected {self.layout}")
        found.sort(key=lambda pair: int(pair[0][1]))
        self._files = [file for _, file in found]
        self._numbers = [int(match[1]) for match, _ in found]
        self._unit = np.float32(depth_unit or 1e-3)
        self._describe(
            name=path.resolve().name,
            camera=check_override(camera, CAMERA, "the NYU data set"),
            frame_names=[file.name for file in self._files],
        )
        labels = path / "joint_data.mat"
        self._joints = _read_joints(labels) if labels.is_file() else None
        if self._joints is not None:
            self.truth = frozenset({"joints"})

    def _read_depth(self, index: int) -> NDArray[Any]:
        pixels = read_png(self._files[index], channels=3, bits=8)  # blue, green, red
        millimetres = pixels[..., 1].astype(np.float32) * 256 + pixels[..., 0]
        return millimetres * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        # The number in the file name counts from 1 and may leave gaps; labels are in its order.
        row = self._numbers[index] - 1
        if self._joints is None or not 0 <= row < len(self._joints):
            return None
        return FrameTruth(joints=self._joints[row], joint_set="nyu36")


def _read_joints(path: Path) -> NDArray[np.float32]:
    """All labels of the first camera [m], shape (nframe, 36, 3), camera frame."""
    from scipy.io import loadmat

    try:
        joints = np.asarray(loadmat(path, variable_names=["joint_xyz"])["joint_xyz"], np.float32)
    except Exception as error:  # scipy raises many kinds on damaged files
        raise DamagedFileError(
            f"{path} is not readable: expected a MATLAB file with joint_xyz ({error})"
        ) from error
    if joints.ndim != 4 or joints.shape[2:] != (36, 3):
        raise DamagedFileError(
            f"joint_xyz in {path} has shape {joints.shape}: expected (cameras, frames, 36, 3)"
        )
    return joints[0] * np.array([1e-3, -1e-3, 1e-3], np.float32)
