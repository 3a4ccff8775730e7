"""Named hand poses, read from a file that people can read and edit: sign language and daily ones.

Layout of the file (TOML), angles in degrees in the order of `handtrack.hand.skeleton.ANGLES`::

    [angles]                       # must name ours, so that no column is misread
    thumb = ["tm_flexion", "tm_abduction", "mcp_flexion", "mcp_abduction", "ip_flexion"]
    finger = ["mcp_flexion", "mcp_abduction", "pip_flexion", "dip_flexion"]

    [poses.B]
    about = "what the hand does"   # optional
    thumb = [60, 20, 40, 0, 50]
    index = [0, -6, 0, 0]          # and middle, ring, little

    [poses.2]
    same_as = "V"
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, MissingFileError
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import ANGLES, FINGERS

POSES_FILE = "data/poses/asl.toml"
"""The poses that come with handtrack."""

_COLUMNS = {
    finger: [name.removeprefix(f"{finger}_") for name in ANGLES if name.startswith(finger)]
    for finger in FINGERS
}


def load_poses(path: str | os.PathLike[str] | None = None) -> dict[str, NDArray[np.float64]]:
    """Joint angles by pose name, in the file's order.

    Args:
        path: The file; None reads the poses that come with handtrack.

    Returns:
        Joint angles [rad], shape (21,), inside the limits of the hand model.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: The file is not a list of poses, or a pose is incomplete or out of limits.
    """
    path = Path(path) if path is not None else artifact_path(POSES_FILE)
    if not path.is_file():
        raise MissingFileError(f"no poses at {path}: expected a TOML file")
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DamagedFileError(f"{path} is not a TOML file: {error}") from error
    _check_columns(path, content.get("angles"))
    entries = content.get("poses")
    if not isinstance(entries, dict) or not entries:
        raise DamagedFileError(f"{path} has no poses: expected tables [poses.NAME]")
    limits = np.degrees(HandModel.load().limits)
    poses: dict[str, NDArray[np.float64]] = {}
    for name in entries:
        degrees = _degrees(path, name, _followed(path, name, entries))
        # Limits come from radians: an angle on its limit may be off by a rounding error.
        outside = (degrees < limits[:, 0] - 1e-6) | (degrees > limits[:, 1] + 1e-6)
        if outside.any():
            worst = int(np.flatnonzero(outside)[0])
            low, high = limits[worst]
            raise DamagedFileError(
                f"{path}: pose {name}: {ANGLES[worst]} is {degrees[worst]:g} degrees: expected "
                f"{low:g} to {high:g}"
            )
        poses[name] = np.radians(degrees.clip(*limits.T))
    return poses


def _check_columns(path: Path, columns: Any) -> None:
    """Refuse angles in another order."""
    expected = {"thumb": _COLUMNS["thumb"], "finger": _COLUMNS["index"]}
    if columns != expected:
        raise DamagedFileError(f"{path}: [angles] is {columns}: expected {expected}")


def _followed(path: Path, name: str, entries: Mapping[str, Any]) -> Mapping[str, Any]:
    """The table that holds a pose's angles."""
    entry = entries[name]
    if not isinstance(entry, dict):
        raise DamagedFileError(f"{path}: pose {name} is {entry!r}: expected a table")
    if "same_as" not in entry:
        return entry
    other = entries.get(entry["same_as"]) if isinstance(entry["same_as"], str) else None
    if not isinstance(other, dict) or "same_as" in other or not set(entry) <= {"same_as", "about"}:
        raise DamagedFileError(
            f"{path}: pose {name} is the same as {entry['same_as']!r}: expected the name of a pose "
            "with angles, and no angles of its own"
        )
    return other


def _degrees(path: Path, name: str, entry: Mapping[str, Any]) -> NDArray[np.float64]:
    """Angles of one pose [degrees], shape (21,)."""
    unknown = set(entry) - {*FINGERS, "about"}
    if unknown:
        raise DamagedFileError(
            f"{path}: pose {name} has {', '.join(sorted(unknown))}: expected {', '.join(FINGERS)}"
        )
    values: list[float] = []
    for finger in FINGERS:
        row = entry.get(finger)
        count = len(_COLUMNS[finger])
        if (
            not isinstance(row, list) or len(row) != count
            or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in row)
        ):  # fmt: skip
            raise DamagedFileError(
                f"{path}: pose {name}: {finger} is {row}: expected {count} numbers [degrees], "
                f"{', '.join(_COLUMNS[finger])}"
            )
        values += row
    degrees = np.array(values, np.float64)
    if not np.isfinite(degrees).all():
        raise DamagedFileError(f"{path}: pose {name} has an angle that is not finite")
    return degrees
