"""Motion of a hand without its shape: 27 numbers per frame that any subject can wear.

A frame is the palm's translation [m], its rotation vector [rad], both in the camera frame, and the
21 joint angles [rad].
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.hand.skeleton import NQ, NV
from handtrack.transforms import matrix_to_quat, matrix_to_rotvec, quat_to_matrix, rotvec_to_matrix

FORMAT_VERSION = 1
"""Version of the layout that is written; others are refused."""

FOLDER = "data/motions"
"""Where the motions that come with handtrack lie."""


def minimum_jerk(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Way gone after a share of the time, both 0 to 1, at rest at both ends (Flash and Hogan)."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Frames of one or several takes of a right hand."""

    poses: NDArray[np.float32]
    """Translation [m] 3, rotation vector [rad] 3, joint angles [rad] 21; shape (n, 27)."""
    elbows: NDArray[np.float32] | None = None
    """Elbow [m], camera frame, shape (n, 3); None when it was not recorded."""
    segment_starts: NDArray[np.int64]
    """First frame of each take, shape (k,), ascending from 0; between takes the motion jumps."""
    frames_per_second: float | None = None
    """Frame rate [1/s], None when it was not recorded."""
    name: str
    """Short name."""
    source: str
    """Where the motion comes from."""
    licence: str
    """Terms of the source."""

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises:
            InputError: An array has the wrong shape or holds something else than finite numbers.
        """
        poses = _matrix("poses", self.poses, NV)
        object.__setattr__(self, "poses", poses)
        if self.elbows is not None:
            elbows = _matrix("elbows", self.elbows, 3)
            if len(elbows) != len(poses):
                raise InputError(f"motion has {len(poses)} poses and {len(elbows)} elbows")
            object.__setattr__(self, "elbows", elbows)
        starts = np.asarray(self.segment_starts)
        if (
            starts.ndim != 1 or starts.dtype.kind not in "iu" or not len(starts)
            or starts[0] != 0 or (np.diff(starts) <= 0).any() or starts[-1] >= len(poses)
        ):  # fmt: skip
            raise InputError(
                f"segment_starts is {starts.tolist()}: expected frames of {len(poses)}, ascending "
                "from 0"
            )
        object.__setattr__(self, "segment_starts", starts.astype(np.int64))
        rate = self.frames_per_second
        if rate is not None and not (np.isfinite(rate) and 0 < rate < 1e5):
            raise InputError(f"frames_per_second is {rate}: expected a positive number [1/s]")

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def segments(self) -> list[slice]:
        """Frames of each take."""
        ends = [*self.segment_starts[1:].tolist(), len(self)]
        return [slice(a, b) for a, b in zip(self.segment_starts.tolist(), ends, strict=True)]

    def to_poses(self) -> NDArray[np.float64]:
        """Pose vectors, shape (n, 28), as `HandResult.pose` and MuJoCo's qpos."""
        values = self.poses.astype(np.float64)
        quats = matrix_to_quat(rotvec_to_matrix(values[:, 3:6]))
        return np.concatenate([values[:, :3], quats, values[:, 6:]], axis=1)

    @classmethod
    def from_poses(
        cls,
        poses: ArrayLike,
        *,
        name: str,
        source: str,
        licence: str,
        elbows: ArrayLike | None = None,
        segment_starts: ArrayLike = (0,),
        frames_per_second: float | None = None,
    ) -> Motion:
        """Motion of pose vectors, shape (n, 28); the other arguments are the fields."""
        poses = _matrix("poses", poses, NQ).astype(np.float64)
        turns = matrix_to_rotvec(quat_to_matrix(poses[:, 3:7]))
        return cls(
            poses=np.concatenate([poses[:, :3], turns, poses[:, 7:]], axis=1).astype(np.float32),
            elbows=None if elbows is None else np.asarray(elbows, np.float32),
            segment_starts=np.asarray(segment_starts),
            frames_per_second=frames_per_second,
            name=name,
            source=source,
            licence=licence,
        )

    def take(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Motion:
        """Every `stride`-th frame from `start` to before `stop`; negative ones count from the end.

        Raises:
            InputError: No frame is left.
        """
        if stride < 1:
            raise InputError(f"stride is {stride}: expected 1 or more")
        first, last, _ = slice(start, stop).indices(len(self))
        chosen = np.arange(first, last, stride)
        if not len(chosen):
            raise InputError(
                f"frames {start}:{'' if stop is None else stop} of {self.name} are none: it has "
                f"{len(self)} frames"
            )
        take_of = np.searchsorted(self.segment_starts, chosen, side="right")
        starts = np.flatnonzero(np.diff(take_of, prepend=-1))
        rate = self.frames_per_second
        return replace(
            self,
            poses=self.poses[chosen],
            elbows=None if self.elbows is None else self.elbows[chosen],
            segment_starts=starts,
            frames_per_second=None if rate is None else rate / stride,
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write an .npz file, replaced as a whole; returns its path."""
        path = Path(path)
        arrays = {
            "format_version": FORMAT_VERSION, "name": self.name, "source": self.source,
            "licence": self.licence, "poses": self.poses, "segment_starts": self.segment_starts,
        }  # fmt: skip
        if self.elbows is not None:
            arrays["elbows"] = self.elbows
        if self.frames_per_second is not None:
            arrays["frames_per_second"] = self.frames_per_second
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            np.savez_compressed(file, **arrays)
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Motion:
        """Read a motion written by `save`.

        Args:
            path: The file, or the name of a motion that comes with handtrack (see data/README.md).

        Raises:
            MissingFileError: There is no such file or motion.
            DamagedFileError: The file is not a motion of a known format.
        """
        path = _find(path)
        try:
            with np.load(path, allow_pickle=False) as data:
                version = int(data["format_version"])
                if version != FORMAT_VERSION:
                    raise DamagedFileError(
                        f"{path} is a motion of format {version}: this version reads "
                        f"{FORMAT_VERSION}"
                    )
                rate = data.get("frames_per_second")
                return cls(
                    poses=data["poses"],
                    elbows=data.get("elbows"),
                    segment_starts=data["segment_starts"],
                    frames_per_second=None if rate is None else float(rate),
                    name=str(data["name"]),
                    source=str(data["source"]),
                    licence=str(data["licence"]),
                )
        except DamagedFileError:
            raise
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is not a motion file: {error}") from error


def _find(path: str | os.PathLike[str]) -> Path:
    """The file, or the motion of that name that comes with handtrack."""
    found = Path(path)
    if found.is_file():
        return found
    if found.suffix in ("", ".npz") and len(found.parts) == 1:
        try:
            return artifact_path(f"{FOLDER}/{found.stem}.npz")
        except MissingFileError:
            pass
    held = ", ".join(motion_names()) or "none"
    raise MissingFileError(
        f"there is no motion file {str(path)!r}: expected an .npz file or one of the motions that "
        f"come with handtrack ({held})"
    )


def motion_names() -> list[str]:
    """Names of the motions that come with handtrack."""
    from handtrack.artifacts import artifact_root

    return sorted(path.stem for path in (artifact_root() / FOLDER).glob("*.npz"))


def _matrix(name: str, values: ArrayLike, columns: int) -> NDArray[np.float32]:
    """Finite numbers, shape (n >= 1, columns)."""
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} of a motion are not numeric: {error}") from None
    if array.ndim != 2 or array.shape[1] != columns or not len(array):
        raise InputError(f"{name} of a motion have shape {array.shape}: expected (n, {columns})")
    if not np.isfinite(array).all():
        raise InputError(f"{name} of a motion are not finite in every frame")
    return array
