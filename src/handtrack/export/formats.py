"""The formats that a track can be written in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from handtrack.errors import InputError
from handtrack.evaluation.run_record import write_whole
from handtrack.export.arrays import arrays
from handtrack.export.bvh import bvh
from handtrack.export.gltf import gltf
from handtrack.export.json_lines import json_lines
from handtrack.export.openxr import openxr
from handtrack.export.table import table
from handtrack.export.track import Track
from handtrack.export.trc import trc


@dataclass(frozen=True, slots=True)
class Format:
    """One format."""

    about: str
    """What it holds."""
    lost: str
    """What it says of a frame in which the hand was not followed."""
    encode: Callable[[Track], bytes]
    """Gives the content of a file."""


_MARKED = "are written too, and their state says so"
_HELD = "hold the last pose"

FORMATS: dict[str, Format] = {
    "csv": Format("a row per frame: pose, keypoints, sigmas", _MARKED, table),
    "jsonl": Format("a JSON document per frame, as the publisher sends it", _MARKED, json_lines),
    "npz": Format("arrays of pose, keypoints and bone frames", _MARKED, arrays),
    "bvh": Format("skeleton and motion, centimetres, y up", _HELD, bvh),
    "glb": Format("animated glTF 2.0: skinned mesh and motion, metres, y up", _HELD, gltf),
    "openxr": Format("26 joints of XR_EXT_hand_tracking, JSON lines", "are not active", openxr),
    "trc": Format("keypoints as markers for OpenSim, millimetres, y up", "have empty cells", trc),
}
"""Name -> format; docs/exports.md describes them."""


def write_track(track: Track, path: str | Path, format: str) -> Path:
    """Write a track; the file is there complete or not at all.

    Args:
        track: The track.
        path: File to write; replaced when it exists.
        format: A name in `FORMATS`.

    Returns:
        The file.

    Raises:
        InputError: There is no such format, the file cannot be written, or the format needs a hand
            that was followed in at least one frame.
    """
    if format not in FORMATS:
        raise InputError(f"no format {format!r}: expected {', '.join(FORMATS)}")
    path = Path(path)
    content = FORMATS[format].encode(track)
    try:
        return write_whole(path, content)
    except OSError as error:
        raise InputError(
            f"{path} cannot be written ({error.strerror}): name a file in a folder that exists"
        ) from error
