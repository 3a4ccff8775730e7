r"""HANDS 2017 challenge and BigHand2.2M (Yuan et al. 2017): a label file, or a folder of images.

Depth is 16-bit PNG in millimetres of a RealSense SR300. A label line is the image's path, then 21
joints as x y z [mm] in the camera frame, separated by tabs or spaces. Paths of BigHand hold spaces
and backslashes, as in ``Subject_1\76 150\image_D00016005.png``.
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
from handtrack.camera.sequence import RecordedSequence, check_override, natural_key
from handtrack.errors import DamagedFileError, InputError, MissingFileError

CAMERA = Camera(width=640, height=480, fx=475.065948, fy=475.065857, cx=315.944855, cy=245.287079)
"""SR300 camera of the data sets."""

_IMAGE = re.compile(r"image_D\d+\.png")
_LINE = re.compile(r"\s*(\S.*?\.png)((?:\s+[-+.0-9eEnNaA]+){63})\s*")
_JOINTS = 21
_LABEL_NAMES = ("Training_Annotation.txt", "training_annotation.txt")

KEYPOINTS_FROM_HANDS17 = np.array(
    [0, 1, 6, 7, 8, 2, 9, 10, 11, 3, 12, 13, 14, 4, 15, 16, 17, 5, 18, 19, 20]
)
"""The data sets' joint (wrist, five MCP, then PIP DIP tip per finger) for each of our keypoints."""


class SequenceHands17(RecordedSequence):
    """The images that a label file lists, or ``image_D00000001.png`` and so on of one folder."""

    format = "hands17"
    layout = "label file such as Training_Annotation.txt, or folder with image_D00000001.png ..."

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A file that starts with a label of 63 numbers, its folder, or a folder of its images."""
        if path.is_file():
            return path.suffix == ".txt" and _first_line_fits(path)
        if (path / "camera.json").exists():  # somebody's own description wins
            return False
        return _own_labels(path) is not None or any(
            _IMAGE.fullmatch(file.name) for file in path.glob("image_D*.png")
        )

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the sequence; frames are read later, one by one."""
        self._unit = np.float32(depth_unit or 1e-3)
        path = path.resolve()
        labels = path if path.is_file() else _own_labels(path)
        joints: NDArray[np.float32] | None = None
        if labels is not None:
            names, joints = _read_labels(labels)
            self._files = _files(labels, names)
        else:
            self._files = sorted(
                (file for file in path.glob("image_D*.png") if _IMAGE.fullmatch(file.name)),
                key=lambda file: natural_key(file.name),
            )
            names = [file.name for file in self._files]
            beside = _own_labels(path.parent)
            if beside is not None:
                joints = _joints_of(names, *_read_labels(beside))
        if not names:
            raise MissingFileError(f"{path} holds no images: expected {self.layout}")
        self._describe(
            name=path.stem,
            camera=check_override(camera, CAMERA, "the HANDS 2017 data set"),
            frame_names=names,
        )
        self._joints = joints
        if joints is not None:
            self.truth = frozenset({"keypoints", "joints"})

    def _read_depth(self, index: int) -> NDArray[Any]:
        pixels = read_png(self._files[index], channels=1, bits=16)
        return pixels.astype(np.float32) * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        if self._joints is None or not np.isfinite(self._joints[index]).any():
            return None
        joints = self._joints[index]
        return FrameTruth(
            keypoints=joints[KEYPOINTS_FROM_HANDS17], joints=joints, joint_set="hands17"
        )


def _first_line_fits(path: Path) -> bool:
    """Whether a text file starts with a label."""
    try:
        with path.open(encoding="utf-8") as file:
            return _LINE.fullmatch(file.readline(8192)) is not None
    except (OSError, ValueError):
        return False


def _own_labels(folder: Path) -> Path | None:
    """The label file of the challenge in a folder."""
    return next((folder / name for name in _LABEL_NAMES if (folder / name).is_file()), None)


def _files(labels: Path, names: list[str]) -> list[Path]:
    """Where the images lie: beside the labels, in ``images`` there, or beside their folder."""
    folder = labels.parent
    relative = [name.replace("\\", "/").lstrip("/") for name in names]
    for root in (folder, folder / "images", folder.parent, folder.parent / "images"):
        # The first image may be the one that is missing.
        if any((root / name).is_file() for name in relative[:20]):
            return [root / name for name in relative]
    if not names:
        return []
    raise MissingFileError(
        f"{labels} lists {names[0]}, which is neither beside it nor in {folder / 'images'}: put "
        "the images there"
    )


def _read_labels(path: Path) -> tuple[list[str], NDArray[np.float32]]:
    """Image names and joints [m], shape (nframe, 21, 3), camera frame, the data set's order."""
    names: list[str] = []
    rows: list[NDArray[np.float32]] = []
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                if not line.strip():
                    continue
                match = _LINE.fullmatch(line)
                if match is None:
                    raise InputError(f"line {number} is no label")
                names.append(match[1])
                rows.append(np.array(match[2].split(), np.float32))
    except (OSError, ValueError) as error:
        raise DamagedFileError(
            f"{path} is not readable: expected an image name and 63 numbers per line ({error})"
        ) from error
    joints = np.stack(rows).reshape(-1, _JOINTS, 3) if rows else np.empty((0, _JOINTS, 3))
    return names, (joints * np.float32(1e-3)).astype(np.float32)


def _joints_of(
    names: list[str], listed: list[str], joints: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Joints of some of the images that a label file lists, NaN for those that it does not."""
    rows = {re.split(r"[\\/]", name)[-1]: row for row, name in enumerate(listed)}
    found = np.full((len(names), _JOINTS, 3), np.nan, np.float32)
    for place, name in enumerate(names):
        if name in rows:
            found[place] = joints[rows[name]]
    return found
