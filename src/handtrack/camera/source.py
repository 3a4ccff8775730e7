"""Open whatever holds depth frames, told apart by content."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from handtrack.camera.camera import Camera
from handtrack.camera.sequence import RecordedSequence, Sequence, check_unit
from handtrack.errors import InputError, MissingFileError

_READERS = {
    "npz": "handtrack.camera.readers.npz:SequenceNpz",
    "nyu": "handtrack.camera.readers.nyu:SequenceNyu",
    "msra": "handtrack.camera.readers.msra:SequenceMsra",
    "icvl": "handtrack.camera.readers.icvl:SequenceIcvl",
    "png": "handtrack.camera.readers.png_folder:SequencePng",
}
"""Format name -> reader, the most particular first: the first that recognises a path reads it."""

FORMATS: tuple[str, ...] = tuple(_READERS)
"""Names of the formats that can be read."""


def reader(format: str) -> type[RecordedSequence]:
    """Class that reads a format.

    Raises:
        InputError: There is no such format.
    """
    if format not in _READERS:
        raise InputError(f"unknown sequence format {format!r}: expected {', '.join(FORMATS)}")
    module, name = _READERS[format].split(":")
    return getattr(import_module(module), name)


def open_sequence(
    source: str | os.PathLike[str] | Sequence,
    *,
    format: str | None = None,
    camera: Camera | None = None,
    depth_unit: float | None = None,
) -> Sequence:
    """Open a recorded depth sequence; frames are read when they are asked for.

    Args:
        source: Folder or file; a `Sequence` is returned as it is.
        format: One of `FORMATS`; None tells it from the content.
        camera: Intrinsics to use instead of the recording's own or its data set's.
        depth_unit: What one step of an integer depth is [m], instead of what the recording says.

    Returns:
        The sequence, to be used in a ``with`` block.

    Raises:
        MissingFileError: The source or a file that must go with it does not exist.
        DamagedFileError: It is there but cannot be read.
        InputError: Its format is not known, or an argument does not fit it.
    """
    if isinstance(source, Sequence):
        return source
    if camera is not None and not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: expected a handtrack.Camera")
    if depth_unit is not None:
        check_unit(depth_unit, "the arguments")
    path = _existing(source)
    chosen = reader(format) if format is not None else _recognise(path)
    return chosen(path, camera=camera, depth_unit=depth_unit)


def _existing(source: str | os.PathLike[str]) -> Path:
    """The source as a path that exists."""
    try:
        path = Path(source).expanduser()
        exists = path.exists()
    except (TypeError, ValueError, OSError, RuntimeError) as error:
        raise InputError(f"source {source!r} is not a path: {error}") from None
    if not exists:
        raise MissingFileError(
            f"no file or folder {str(path)!r} (the current folder is {Path.cwd()}): expected a "
            "recorded depth sequence"
        )
    return path


def _recognise(path: Path) -> type[RecordedSequence]:
    """The reader for a path, by its content."""
    for name in FORMATS:
        candidate = reader(name)
        if candidate.recognises(path):
            return candidate
    raise InputError(f"{path} is not a depth sequence: {_content(path)}; expected {_layouts()}")


def _content(path: Path) -> str:
    """What there is instead, in a few words."""
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(8)
        return f"it is a file that starts with {start!r}" if start else "it is an empty file"
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    if not names:
        return "it is an empty folder"
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f"it is a folder with {', '.join(names[:4])}{more}"


def _layouts() -> str:
    """All layouts in one line."""
    return "; ".join(f"{name}: {reader(name).layout}" for name in FORMATS)
