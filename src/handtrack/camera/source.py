"""Open whatever holds depth frames, told apart by content."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from handtrack.camera.camera import Camera
from handtrack.camera.live import LiveSequence
from handtrack.camera.sequence import RecordedSequence, Sequence, check_unit
from handtrack.errors import InputError, MissingFileError

_READERS = {
    "npz": "handtrack.camera.readers.npz:SequenceNpz",
    "nyu": "handtrack.camera.readers.nyu:SequenceNyu",
    "msra": "handtrack.camera.readers.msra:SequenceMsra",
    "icvl": "handtrack.camera.readers.icvl:SequenceIcvl",
    "hands17": "handtrack.camera.readers.hands17:SequenceHands17",
    "dexter1": "handtrack.camera.readers.dexter1:SequenceDexter1",
    "realsense": "handtrack.camera.readers.realsense:SequenceRealSense",
    "rosbag1": "handtrack.camera.readers.rosbag:SequenceRosbag1",
    "rosbag2": "handtrack.camera.readers.rosbag:SequenceRosbag2",
    "mcap": "handtrack.camera.readers.rosbag:SequenceMcap",
    "png": "handtrack.camera.readers.png_folder:SequencePng",
}
"""Format name -> reader, the most particular first: the first that recognises a path reads it."""

FORMATS: tuple[str, ...] = tuple(_READERS)
"""Names of the formats that can be read."""

LIVE_SOURCES: dict[str, str] = {
    "realsense": "a RealSense depth camera; realsense:SERIAL takes a certain one",
    "replay": "replay:PATH plays a recording as if it was a camera, over and over",
}
"""Name of a live source -> what it is."""


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
    topic: str | None = None,
) -> Sequence:
    """Open a recorded depth sequence or a live camera.

    Frames of a recording are read when they are asked for; of a live source the newest is given
    (`handtrack.camera.live`).

    Args:
        source: Folder or file, or a live source, a name of `LIVE_SOURCES` with what it needs after
            a colon; ``./realsense`` is a folder of that name. A `Sequence` is returned as it is.
        format: One of `FORMATS`; None tells it from the content.
        camera: Intrinsics to use instead of the recording's own or its data set's.
        depth_unit: What one step of an integer depth is [m], instead of what the recording says.
        topic: Which image stream of a ROS bag or MCAP file; None takes the depth if there is one.

    Returns:
        The sequence, to be used in a ``with`` block.

    Raises:
        MissingFileError: The source or a file that must go with it does not exist.
        DamagedFileError: It is there but cannot be read.
        InputError: Its format is not known, or an argument does not fit it.
        DeviceError: The camera is not there or does not start.
        MissingDependencyError: A package for this kind of source is not installed.
    """
    if isinstance(source, Sequence):
        return source
    if camera is not None and not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: expected a handtrack.Camera")
    if depth_unit is not None:
        check_unit(depth_unit, "the arguments")
    kind, _, detail = source.partition(":") if isinstance(source, str) else ("", "", "")
    if kind in LIVE_SOURCES and format is None:
        return _open_live(kind, detail, camera)
    path = _existing(source)
    chosen = reader(format) if format is not None else _recognise(path)
    more = {}
    if topic is not None:
        if not chosen.has_topics:
            raise InputError(f"{path} has the format {chosen.format}, which knows no topics")
        more["topic"] = topic
    return chosen(path, camera=camera, depth_unit=depth_unit, **more)


def _open_live(kind: str, detail: str, camera: Camera | None) -> LiveSequence:
    """A live source by its name and what stands after the colon."""
    if kind == "realsense":
        from handtrack.camera.readers.realsense_live import RealSenseDriver

        return LiveSequence(RealSenseDriver(detail), format=kind, camera=camera)
    from handtrack.camera.readers.replay import ReplayDriver

    if not detail:
        raise InputError("replay needs a recording to play: expected replay:PATH")
    # A path, unlike a text, is never taken for another live source.
    with open_sequence(Path(detail)) as recording:
        assert isinstance(recording, RecordedSequence)
        driver = ReplayDriver(recording)
    return LiveSequence(driver, format=kind, camera=camera)


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
