"""A folder of 16-bit PNG images with a camera.json, or one PNG with a JSON file beside it."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import FrameTruth
from handtrack.camera.png import is_png, read_png, read_png_header
from handtrack.camera.sequence import (
    RecordedSequence,
    Subject,
    check_override,
    check_times,
    check_unit,
    natural_key,
)
from handtrack.errors import DamagedFileError, InputError, MissingFileError

EXAMPLE = (
    '{"width": 640, "height": 480, "fx": 475.1, "fy": 475.1, "cx": 315.9, "cy": 245.3, '
    '"depth_unit_m": 0.001, "frames_per_second": 30}'
)
"""A complete camera.json."""


class SequencePng(RecordedSequence):
    """16-bit PNG images: value x depth_unit_m = depth [m], 0 = no measurement."""

    format = "png"
    layout = "folder of 16-bit PNG and camera.json, or one PNG with a JSON file of the same name"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A PNG file, or a folder with at least one."""
        if path.is_file():
            return is_png(path)
        return next(path.glob("*.[pP][nN][gG]"), None) is not None

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the folder or the single image; frames are read later, one by one."""
        if path.is_file():
            self._files, description = [path], path.with_suffix(".json")
        else:
            self._files = sorted(path.glob("*.[pP][nN][gG]"), key=lambda p: natural_key(p.name))
            description = path / "camera.json"
        if not self._files:
            raise MissingFileError(f"{path} holds no PNG image: expected 16-bit depth images")
        facts = _read_facts(description, optional=camera is not None and depth_unit is not None)

        unit = facts.get("depth_unit_m") if depth_unit is None else depth_unit
        if unit is None:
            raise InputError(f"{description} lacks depth_unit_m; a complete one: {EXAMPLE}")
        self._unit = np.float32(check_unit(unit, str(description)))
        if facts or camera is None:
            try:
                own = Camera.from_dict(facts.get("camera", facts))
            except InputError as error:
                raise InputError(f"{description}: {error}; a complete one: {EXAMPLE}") from None
            camera = check_override(camera, own, str(description))
        _check_first(self._files, camera)

        rate = facts.get("frames_per_second")
        if rate is not None and not (isinstance(rate, (int, float)) and 0 < rate < 1e5):
            raise InputError(f"frames_per_second in {description} is {rate!r}: expected 1/s")
        self._describe(
            name=path.stem if path.is_file() else path.resolve().name,
            camera=camera,
            frame_names=[file.name for file in self._files],
            frames_per_second=rate,
            times=_read_times(description, facts, [file.name for file in self._files]),
        )
        self._truth = _read_labels(facts, description) if path.is_file() else None
        if self._truth is not None and self._truth.joints is not None:
            self.truth = frozenset({"joints"})
        if facts.get("hand") in ("left", "right"):
            self.subject = Subject(side=facts["hand"])

    def _read_depth(self, index: int) -> NDArray[Any]:
        pixels = read_png(self._files[index], channels=1, bits=16)
        return pixels.astype(np.float32) * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        return self._truth


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It is not JSON, or not an object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingFileError(f"{path} does not exist") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedFileError(f"{path} is not readable as JSON: {error}") from error
    if not isinstance(content, dict):
        raise DamagedFileError(f"{path} holds a JSON {type(content).__name__}: expected an object")
    return content


def _read_facts(path: Path, *, optional: bool) -> dict[str, Any]:
    """The description of the images; empty if it is missing and not needed."""
    try:
        return read_json(path)
    except MissingFileError:
        if optional:
            return {}
        raise MissingFileError(
            f"{path} is missing: the images' camera and depth unit are not known; write it, "
            f"for example: {EXAMPLE}"
        ) from None


def _check_first(files: list[Path], camera: Camera) -> None:
    """Compare the first readable image with the camera, so that a mismatch shows at once."""
    for file in files:
        try:
            header = read_png_header(file)
        except DamagedFileError:
            continue
        if (header.channels, header.bits) != (1, 16):
            raise InputError(
                f"{file} has {header.channels} channel(s) of {header.bits} bits: expected depth "
                "as one channel of 16 bits; 8-bit and colour pictures hold no metric depth"
            )
        if (header.height, header.width) != camera.shape:
            raise InputError(
                f"{file} is {header.width}x{header.height}: its camera says "
                f"{camera.width}x{camera.height}; give the intrinsics of this image size"
            )
        return


def _read_times(
    description: Path, facts: dict[str, Any], names: list[str]
) -> NDArray[np.float64] | None:
    """Time stamps [s] from times.csv (columns file, time_s) or from the entry times_s."""
    table = description.with_name("times.csv")
    if description.name == "camera.json" and table.is_file():
        stamps: dict[str, float] = {}
        try:
            text = table.read_text(encoding="utf-8")
            for row in csv.DictReader(io.StringIO(_without_broken_end(text), newline="")):
                stamps[row["file"]] = float(row["time_s"])
        except (KeyError, TypeError, ValueError, OSError, csv.Error) as error:
            raise DamagedFileError(
                f"{table} is not readable: expected a header line 'file,time_s' and one line per "
                f"image ({type(error).__name__}: {error})"
            ) from error
        absent = [name for name in names if name not in stamps]
        if absent:
            raise DamagedFileError(
                f"{table} has no time for {absent[0]} and {len(absent) - 1} other images"
            )
        return check_times([stamps[name] for name in names], len(names), str(table))
    if facts.get("times_s") is not None:
        return check_times(facts["times_s"], len(names), str(description))
    return None


def _without_broken_end(text: str) -> str:
    """A table without the line in the middle of which a recording was cut off."""
    lines, _, last = text.rpartition("\n")
    name, _, time = last.rpartition(",")
    return lines if last and not (name and _is_number(time)) else text


def _is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_labels(facts: dict[str, Any], where: Path) -> FrameTruth | None:
    """Labels in a single image's description: `hand` and `joints_<set>_m`."""
    side = facts.get("hand") if facts.get("hand") in ("left", "right") else None
    for name, values in facts.items():
        if name.startswith("joints_") and name.endswith("_m"):
            try:
                joints = np.array(values, np.float32)
            except (TypeError, ValueError):
                joints = np.empty(0, np.float32)
            if joints.ndim != 2 or joints.shape[-1] != 3:
                raise DamagedFileError(f"{name} in {where}: expected a list of x y z in metres")
            return FrameTruth(joints=joints, joint_set=name[len("joints_") : -2], side=side)
    return FrameTruth(side=side) if side else None
