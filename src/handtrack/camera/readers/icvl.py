"""ICVL Hand Posture data set (Tang et al. 2014): one labelled sequence, or a folder of its images.

Depth is 16-bit PNG in millimetres. A label line is the image's path below Depth/, then 16 joints as
u v d (pixels, pixels, millimetres).
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

CAMERA = Camera(width=320, height=240, fx=240.99, fy=240.96, cx=160.0, cy=120.0)
"""Creative Interactive Gesture Camera of the data set."""
_LINE = re.compile(r"(\S+\.png)((?:\s+\S+){48})\s*")
_JOINTS = 16


class SequenceIcvl(RecordedSequence):
    """The images that one label file lists, or those of one folder below Depth/."""

    format = "icvl"
    layout = "label file such as test_seq_1.txt beside Depth/, or a folder such as Depth/test_seq_1"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A label file, the folder with exactly one beside Depth/, or a folder inside Depth/."""
        if path.is_file():
            return path.suffix == ".txt" and _first_line_fits(path)
        if (path / "Depth").is_dir():
            return True
        path = path.resolve()
        inside = path.parent.name == "Depth" and not (path / "camera.json").exists()
        return inside and next(path.glob("image_*.png"), None) is not None

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the sequence; frames are read later, one by one."""
        self._unit = np.float32(depth_unit or 1e-3)
        path = path.resolve()
        if path.is_dir() and (path / "Depth").is_dir():
            path = _only_labels(path)
        if path.is_file():
            root, names, uvd = path.parent / "Depth", *_read_labels(path)
        else:
            names = [f"{path.name}/{file.name}" for file in path.glob("*.png")]
            names.sort(key=natural_key)
            root, uvd = path.parent, None
            labels = root.parent / f"{path.name}.txt"
            if labels.is_file():
                listed, values = _read_labels(labels)
                rows = dict(zip(listed, values, strict=True))
                unknown = np.full((_JOINTS, 3), np.nan)
                uvd = np.stack([rows.get(name, unknown) for name in names]) if names else None
        if not names:
            raise MissingFileError(f"{path} holds no ICVL images: expected {self.layout}")
        self._files = [root / name for name in names]
        self._describe(
            name=path.stem,
            camera=check_override(camera, CAMERA, "the ICVL data set"),
            frame_names=names,
        )
        self._joints: NDArray[np.float32] | None = None
        if uvd is not None:
            points = self.camera.unproject(uvd[..., :2], uvd[..., 2] * 1e-3)
            self._joints = points.astype(np.float32)
            self.truth = frozenset({"joints"})

    def _read_depth(self, index: int) -> NDArray[Any]:
        pixels = read_png(self._files[index], channels=1, bits=16)
        return pixels.astype(np.float32) * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        if self._joints is None or np.isnan(self._joints[index]).all():
            return None
        return FrameTruth(joints=self._joints[index], joint_set="icvl16")


def _first_line_fits(path: Path) -> bool:
    """Whether a text file starts with an ICVL label."""
    try:
        with path.open(encoding="utf-8") as file:
            return _LINE.fullmatch(file.readline(4096)) is not None
    except (OSError, ValueError):
        return False


def _only_labels(folder: Path) -> Path:
    """The one label file beside Depth/."""
    files = sorted(file for file in folder.glob("*.txt") if _first_line_fits(file))
    if len(files) == 1:
        return files[0]
    below = sorted(entry.name for entry in (folder / "Depth").iterdir() if entry.is_dir())
    choice = [file.name for file in files] or [f"Depth/{name}" for name in below]
    if not choice:
        raise MissingFileError(f"{folder} holds no label file and Depth/ has no folder")
    raise InputError(
        f"{folder} holds {len(files)} label files: give one sequence, such as "
        f"{', '.join(str(folder / name) for name in choice[:3])}"
    )


def _read_labels(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Image names and joints u v d [pixels, pixels, mm], shape (nframe, 16, 3)."""
    names: list[str] = []
    rows: list[NDArray[np.float64]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            match = _LINE.fullmatch(line)
            if match is None:
                raise DamagedFileError(
                    f"{path} line {number} is not a label: expected an image name and 48 numbers"
                )
            names.append(match[1])
            rows.append(np.array(match[2].split(), np.float64).reshape(_JOINTS, 3))
    except DamagedFileError:
        raise
    except (OSError, ValueError) as error:
        raise DamagedFileError(f"{path} is not readable as ICVL labels: {error}") from error
    return names, np.stack(rows) if rows else np.empty((0, _JOINTS, 3))
