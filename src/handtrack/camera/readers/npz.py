"""The project's own recording: one .npz with depth, camera, time and labels (docs/formats.md)."""

from __future__ import annotations

import contextlib
import os
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import FrameTruth
from handtrack.camera.sequence import (
    RecordedSequence,
    Subject,
    check_override,
    check_times,
    check_unit,
)
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import whole_file

FORMAT_VERSION = 1
"""Version of the layout that is written; higher ones are refused."""

DEFAULT_NAME = "sequence.npz"
"""File that is read when a folder is given."""

VERIFIED_BYTES = 64 * 2**20
"""Depth up to this size [bytes] has its checksum verified on opening, a larger one on its way."""

_BROKEN = (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError)
_LABELS = {"truth_pose": (28,), "truth_keypoints": (21, 3)}


class SequenceNpz(RecordedSequence):
    """Depth (n, height, width) as integers with depth_unit_m, or as float metres."""

    format = "npz"
    layout = ".npz file with the arrays depth and camera, or folder with one named sequence.npz"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A file that is called .npz, even a damaged one, a zip archive, or the folder of one."""
        if not path.is_file():
            return (path / DEFAULT_NAME).is_file()
        if path.suffix.lower() == ".npz":
            return True
        with path.open("rb") as file:
            return file.read(4) == b"PK\x03\x04"

    def __init__(
        self, path: Path, *, camera: Camera | None = None, depth_unit: float | None = None
    ) -> None:
        """Open the archive and read all of it but the depth."""
        name = path.stem if path.is_file() else path.resolve().name
        path = path if path.is_file() else path / DEFAULT_NAME
        if not path.is_file():
            raise MissingFileError(f"{path.parent} holds no {DEFAULT_NAME}")
        self._depth = _DepthStream(path)
        count, height, width = self._depth.shape
        facts = _read_small(path)

        values = facts.get("camera")
        if values is not None:
            own = _camera(values, path)
            if own.shape != (height, width):
                raise DamagedFileError(
                    f"{path}: depth is {width}x{height}, its camera {own.width}x{own.height}"
                )
            camera = check_override(camera, own, str(path))
        elif camera is None:
            raise InputError(
                f"{path} has no array camera (width, height, fx, fy, cx, cy): add it, or give one "
                "with camera="
            )

        unit = facts.get("depth_unit_m") if depth_unit is None else depth_unit
        if unit is None and self._depth.dtype.kind != "f":
            raise InputError(
                f"{path} holds {self._depth.dtype} depth without depth_unit_m: add it, or give it "
                "with depth_unit= (0.001 for millimetres)"
            )
        self._unit = np.float32(1.0 if unit is None else check_unit(_scalar(unit), str(path)))

        times = facts.get("time")
        rate = _scalar(facts.get("frames_per_second"))
        self._describe(
            name=name,
            camera=camera,
            frame_names=[f"{name}[{index}]" for index in range(count)],
            frames_per_second=float(rate) if rate is not None else None,
            times=None if times is None else check_times(times, count, str(path)),
        )
        self._labels = {label: facts[label] for label in _LABELS if label in facts}
        for label, values in self._labels.items():
            if values.shape != (count, *_LABELS[label]):
                raise DamagedFileError(
                    f"{label} in {path} has shape {values.shape}: expected "
                    f"{(count, *_LABELS[label])}"
                )
        self.truth = frozenset(label.removeprefix("truth_") for label in self._labels)
        side, scale = facts.get("side"), _scalar(facts.get("scale"))
        self.subject = Subject(
            side=None if side is None else str(side),
            alpha=facts.get("shape_alpha"),
            beta=facts.get("shape_beta"),
            scale=None if scale is None else float(scale),
        )

    def _read_depth(self, index: int) -> NDArray[Any]:
        return self._depth.read(index).astype(np.float32, copy=False) * self._unit

    def _read_truth(self, index: int) -> FrameTruth | None:
        if not self._labels:
            return None
        pose, keypoints = (self._labels.get(name) for name in _LABELS)
        return FrameTruth(
            pose=None if pose is None else np.array(pose[index], np.float64),
            keypoints=None if keypoints is None else np.array(keypoints[index], np.float32),
            side=self.subject.side if self.subject else None,
        )

    def close(self) -> None:
        """Close the file."""
        self._depth.close()


class _DepthStream:
    """The array `depth` inside an archive, read frame by frame as it is decompressed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._member: BinaryIO | None = None
        self._next = 0
        self._broken: tuple[int, str] | None = None
        try:
            self._archive = zipfile.ZipFile(path)
        except _BROKEN as error:
            raise DamagedFileError(
                f"{path} is not a complete .npz archive ({error}): copy or record it again"
            ) from error
        try:
            self._open_depth()
        except BaseException:
            self._archive.close()
            raise

    def _open_depth(self) -> None:
        """Read the header of the array and check that the data can be there."""
        names = self._archive.namelist()
        if "depth.npy" not in names:
            held = ", ".join(name.removesuffix(".npy") for name in names[:6]) or "nothing"
            raise InputError(
                f"{self._path} is no depth sequence: it holds {held}; expected depth and camera"
            )
        info = self._archive.getinfo("depth.npy")
        try:
            if info.file_size <= VERIFIED_BYTES:
                with self._archive.open("depth.npy") as member:
                    while member.read(2**20):
                        pass
            with self._archive.open("depth.npy") as member:
                shape, fortran, dtype = _read_header(cast(BinaryIO, member))
                self._start = member.tell()
        except _BROKEN as error:
            raise DamagedFileError(f"depth in {self._path} is corrupt: {error}") from error
        self.dtype = dtype
        """Type of the stored values."""
        if dtype.kind not in "fiu" or fortran or len(shape) not in (2, 3) or 0 in shape:
            order = ", Fortran order" if fortran else ""
            raise DamagedFileError(
                f"depth in {self._path} is {dtype} with shape {shape}{order}: expected numbers of "
                "shape (frames, height, width) in C order"
            )
        self.shape = (shape[0] if len(shape) == 3 else 1, shape[-2], shape[-1])
        """Frames, height, width."""
        self._frame_bytes = self.shape[1] * self.shape[2] * dtype.itemsize
        expected = self._start + self.shape[0] * self._frame_bytes
        if info.file_size != expected:
            raise DamagedFileError(
                f"depth in {self._path} has {info.file_size} bytes: its header says {expected}"
            )

    def read(self, index: int) -> NDArray[Any]:
        """One frame as it is stored, shape (height, width)."""
        if self._broken is not None and index >= self._broken[0]:
            raise DamagedFileError(self._broken[1])
        try:
            if self._member is None or index < self._next:
                self._rewind()
            member = cast(BinaryIO, self._member)
            while True:
                data = member.read(self._frame_bytes)
                if len(data) != self._frame_bytes:
                    raise EOFError("the data ends early")
                self._next += 1
                if self._next > index:
                    return np.frombuffer(data, self.dtype).reshape(self.shape[1:])
        except _BROKEN as error:
            # A compressed stream cannot be picked up again behind the damage.
            message = f"{self._path} is corrupt from frame {self._next} on: {error}"
            self._broken = (self._next, message)
            raise DamagedFileError(message) from error

    def _rewind(self) -> None:
        """Stand before the first frame."""
        if self._member is not None:
            self._member.close()
        self._member, self._next = cast(BinaryIO, self._archive.open("depth.npy")), 0
        self._member.read(self._start)

    def close(self) -> None:
        if self._member is not None:
            self._member.close()
        self._archive.close()


def write_npz_sequence(
    path: str | os.PathLike[str],
    depth: Iterable[ArrayLike],
    camera: Camera,
    *,
    depth_unit: float = 0.0005,
    time: ArrayLike | None = None,
    frames_per_second: float | None = None,
    truth_pose: ArrayLike | None = None,
    truth_keypoints: ArrayLike | None = None,
    side: str | None = None,
    shape_alpha: ArrayLike | None = None,
    shape_beta: ArrayLike | None = None,
    scale: float | None = None,
    source: str = "",
    licence: str = "",
) -> Path:
    """Write a recording that `open_sequence` reads.

    Args:
        path: File to write, by custom with the ending .npz; replaced as a whole.
        depth: Frames [m], each of shape (height, width); an array (n, height, width) or a
            generator. They are rounded to whole steps of `depth_unit`.
        camera: Intrinsics of all frames.
        depth_unit: Step of the stored uint16 depth [m]; the farthest depth is 65535 of them.
        time: Time stamps [s], shape (n,).
        frames_per_second: Frame rate [1/s].
        truth_pose: Pose vectors, shape (n, 28).
        truth_keypoints: Keypoints [m], shape (n, 21, 3), camera frame.
        side: "right" or "left".
        shape_alpha: Bone-scale coefficients of the subject, shape (nalpha,).
        shape_beta: Surface coefficients of the subject, shape (nbeta,).
        scale: Overall factor on the subject's size.
        source: Where the recording comes from.
        licence: Terms under which it may be used.

    Returns:
        The path written.

    Raises:
        InputError: An array has the wrong shape, or a depth does not fit into 65535 steps.
    """
    path = Path(path)
    check_unit(depth_unit, "the arguments")
    steps = [_steps(frame, camera, depth_unit, place) for place, frame in enumerate(depth)]
    if not steps:
        raise InputError("there is no frame to write: expected at least one depth image")
    arrays: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "depth": np.stack(steps),
        "depth_unit_m": depth_unit,
        "camera": np.array(list(camera.to_dict().values()), np.float64),
        "source": source,
        "licence": licence,
    }
    if time is not None:
        arrays["time"] = check_times(time, len(steps), "the argument time")
    for name, values in (("truth_pose", truth_pose), ("truth_keypoints", truth_keypoints)):
        if values is not None:
            arrays[name] = np.asarray(values, np.float32 if "key" in name else np.float64)
            expected = (len(steps), *_LABELS[name])
            if arrays[name].shape != expected:
                raise InputError(f"{name} has shape {arrays[name].shape}: expected {expected}")
    if side not in (None, "left", "right"):
        raise InputError(f"side is {side!r}: expected 'left' or 'right'")
    extra = {"frames_per_second": frames_per_second, "side": side, "shape_alpha": shape_alpha,
             "shape_beta": shape_beta, "scale": scale}  # fmt: skip
    arrays.update({name: value for name, value in extra.items() if value is not None})

    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        np.savez_compressed(file, **arrays)
    return path


def _steps(frame: ArrayLike, camera: Camera, unit: float, place: int) -> NDArray[np.uint16]:
    """A frame in whole steps of the depth unit."""
    metres = np.asarray(frame)
    if metres.shape != camera.shape or metres.dtype.kind != "f":
        raise InputError(
            f"frame {place} is {metres.dtype} with shape {metres.shape}: expected metres as "
            f"floats, shape {camera.shape}"
        )
    steps = np.rint(np.nan_to_num(metres.astype(np.float64), posinf=0.0, neginf=0.0) / unit)
    if steps.max() > 65535 or steps.min() < 0:
        raise InputError(
            f"frame {place} reaches from {metres.min():g} to {metres.max():g} m: with a depth unit "
            f"of {unit:g} m expected 0 to {65535 * unit:g} m; choose a larger depth_unit"
        )
    return steps.astype(np.uint16)


def _read_header(member: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type from the start of a .npy member."""
    version = npy.read_magic(member)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"unknown .npy version {version}")
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    return read(member)


def _read_small(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays but the depth."""
    facts: dict[str, NDArray[Any]] = {}
    try:
        with contextlib.closing(np.load(path, allow_pickle=False)) as archive:
            for name in archive.files:
                if name != "depth":
                    facts[name] = archive[name]
    except _BROKEN as error:
        raise DamagedFileError(f"{path} cannot be read: {error}") from error
    version = _scalar(facts.get("format_version", np.array(FORMAT_VERSION)))
    if not 1 <= version <= FORMAT_VERSION:
        raise DamagedFileError(
            f"{path} has format version {version}: this handtrack reads up to {FORMAT_VERSION}; "
            "update it"
        )
    for name in ("shape_alpha", "shape_beta", *_LABELS):
        if name in facts and facts[name].dtype.kind not in "fiu":
            raise DamagedFileError(f"{name} in {path} is {facts[name].dtype}: expected numbers")
    return facts


def _camera(values: NDArray[Any], path: Path) -> Camera:
    """Camera from the six stored numbers."""
    if values.shape != (6,) or values.dtype.kind not in "fiu":
        raise DamagedFileError(
            f"camera in {path} is {values.dtype} with shape {values.shape}: expected width, "
            "height, fx, fy, cx, cy"
        )
    names = ("width", "height", "fx", "fy", "cx", "cy")
    try:
        return Camera.from_dict(dict(zip(names, values.tolist(), strict=True)))
    except InputError as error:
        raise DamagedFileError(f"{path}: {error}") from None


def _scalar(value: Any) -> Any:
    """The single value of a 0-dimensional array, or what it is."""
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
