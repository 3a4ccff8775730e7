"""Recordings of grasps, and the database of them (thesis III.3; docs/grasp.md has the format)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.grasp.phases import PHASES, phase_numbers
from handtrack.grasp.reference import sampled_poses
from handtrack.grasp.taxonomy import GRIP_MODES
from handtrack.hand.skeleton import NBONE
from handtrack.transforms import moved_poses, rotvec_to_matrix

Float = NDArray[np.float64]

FORMAT_VERSION = 1

FRAME_RATE = 120.0
"""Frames per second of the recordings of the database."""

STEPS: tuple[float, float, float] = (5e-5, 1.0 / 8192.0, 4e-4)
"""What one unit of a written file's whole numbers is: metres, quaternion parts, radians."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspRecording:
    """One grasp of one object. Frame: the object's at rest with z up, x as in the grasp frame."""

    grip: str
    """Name of the grip mode."""
    object: str
    """Name of the object."""
    trial: int
    """Number of the trial of this grip mode and object."""
    provenance: str
    """Where it comes from, such as "computed" or the name of a data set."""
    frame_rate: float
    """Frames per second."""
    hand_poses: Float
    """Right hand, shape (nframe, 28)."""
    object_poses: Float
    """Object: centre of mass [m] and quaternion, shape (nframe, 7)."""
    phases: NDArray[np.str_]
    """Phase of each frame, names of `PHASES` in their order, shape (nframe,)."""
    contact_bones: NDArray[np.int64]
    """Bones that touch the object in the grasp, shape (ncontact,)."""
    contact_local: Float
    """Where on the hand [m], bone frames, shape (ncontact, 3)."""
    contact_points: Float
    """Where on the object [m], its frame, shape (ncontact, 3)."""
    contact_normals: Float
    """Outward normals of the object there, shape (ncontact, 3)."""

    def __post_init__(self) -> None:
        """Check shapes, names and order.

        Raises:
            InputError: Something does not fit.
        """
        count, touching = len(self.hand_poses), len(self.contact_bones)
        wanted = {
            "hand_poses": (count, 28), "object_poses": (count, 7), "phases": (count,),
            "contact_bones": (touching,), "contact_local": (touching, 3),
            "contact_points": (touching, 3), "contact_normals": (touching, 3),
        }  # fmt: skip
        for name, shape in wanted.items():
            given = np.asarray(getattr(self, name))
            if given.shape != shape:
                raise InputError(f"{self.label}: {name} has shape {given.shape}; expected {shape}")
            if given.dtype.kind == "f" and not np.isfinite(given).all():
                raise InputError(f"{self.label}: {name} holds numbers that are not finite")
        if self.grip not in GRIP_MODES:
            raise InputError(f"no grip mode {self.grip!r}; there are {', '.join(GRIP_MODES)}")
        if not (np.isfinite(self.frame_rate) and self.frame_rate > 0):
            raise InputError(f"{self.label}: frame_rate is {self.frame_rate}; expected more than 0")
        phase_numbers(self.phases, of=self.label)
        if len(self.of_phase("closing")) < 2:
            raise InputError(f"{self.label}: the closing phase has fewer than two frames")
        if touching and not 0 <= self.contact_bones.min() <= self.contact_bones.max() < NBONE:
            raise InputError(f"{self.label}: a contact is on a bone that does not exist")
        norms = np.linalg.norm(self.hand_poses[:, 3:7], axis=1)
        norms = np.concatenate([norms, np.linalg.norm(self.object_poses[:, 3:], axis=1)])
        if np.abs(norms - 1.0).max() > 1e-3:
            raise InputError(f"{self.label}: a quaternion is not of length one (w x y z)")

    @property
    def label(self) -> str:
        """Grip mode, object and trial, for messages."""
        return f"{self.grip} of {self.object}, trial {self.trial}"

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return (len(self.hand_poses) - 1) / self.frame_rate

    def of_phase(self, name: str) -> NDArray[np.intp]:
        """Numbers of the frames of a phase."""
        return np.flatnonzero(self.phases == name)

    @property
    def grasp_frame(self) -> int:
        """Number of the frame of the grasp: the last one of the closing phase."""
        return int(self.of_phase("closing")[-1])

    @property
    def closing_in_grasp_frame(self) -> Float:
        """The closing motion at `FRAME_RATE`, shape (n, 28); recordings lie in the grasp frame."""
        motion = self.hand_poses[self.of_phase("closing")]
        if self.frame_rate == FRAME_RATE:
            return motion
        count = max(round((len(motion) - 1) / self.frame_rate * FRAME_RATE) + 1, 2)
        frames = np.arange(len(motion), dtype=np.float64)
        return sampled_poses(frames, motion, np.linspace(0.0, frames[-1], count))


def grasp_yaw(pose: ArrayLike, centre: ArrayLike) -> float:
    """Angle about z [rad] of the grasp frame's x axis: from the hand to the object's centre.

    The hand's place is its wrist: the palm may be right above the object, whose direction would
    then mean nothing.

    Args:
        pose: The grasp, in a frame with z up, shape (28,).
        centre: Centre of mass of the object [m], the same frame, shape (3,).
    """
    way = np.asarray(centre, np.float64) - np.asarray(pose, np.float64)[:3]
    return float(np.arctan2(way[1], way[0]))


def turned_poses(poses: ArrayLike, yaw: float, shift: ArrayLike = (0.0, 0.0, 0.0)) -> Float:
    """Poses of a hand or an object turned by `yaw` about z and then shifted, shape (..., 7 or 28).

    Args:
        poses: Place [m], quaternion and perhaps angles, shape (..., 7) or (..., 28).
        yaw: Angle about z [rad].
        shift: Way to go afterwards [m], shape (3,).
    """
    return moved_poses(poses, rotvec_to_matrix(np.array([0.0, 0.0, yaw])), shift)


@dataclass(frozen=True, slots=True)
class GraspDatabase:
    """Recordings of grasps."""

    recordings: tuple[GraspRecording, ...]

    def __len__(self) -> int:
        """Number of recordings."""
        return len(self.recordings)

    def __iter__(self) -> Iterator[GraspRecording]:
        """One recording after the other."""
        return iter(self.recordings)

    @property
    def grips(self) -> tuple[str, ...]:
        """Grip modes that there are recordings of, in the order of the taxonomy."""
        held = {recording.grip for recording in self.recordings}
        return tuple(grip for grip in GRIP_MODES if grip in held)

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that there are recordings of, sorted."""
        return tuple(sorted({recording.object for recording in self.recordings}))

    def of_grip(self, grip: str) -> tuple[GraspRecording, ...]:
        """Recordings of one grip mode."""
        return tuple(recording for recording in self.recordings if recording.grip == grip)

    def joined(self, others: Iterable[GraspRecording]) -> GraspDatabase:
        """This database and further recordings, such as one's own."""
        return GraspDatabase((*self.recordings, *others))

    def save(self, path: str | Path) -> None:
        """Write to .npz: whole numbers, each frame as the difference from the one before."""
        frames = [len(r.hand_poses) for r in self]
        contacts = [len(r.contact_bones) for r in self]
        phases = np.concatenate([phase_numbers(r.phases, of=r.label) for r in self])
        entries: dict[str, Any] = {
            name: np.concatenate([getattr(r, name) for r in self]).astype(np.float32)
            for name in ("contact_local", "contact_points", "contact_normals")
        }
        with whole_file(Path(path)) as file:
            np.savez_compressed(
                file, format_version=FORMAT_VERSION, steps=np.array(STEPS),
                grips=np.array([r.grip for r in self]), objects=np.array([r.object for r in self]),
                trials=np.array([r.trial for r in self], np.int32),
                provenances=np.array([r.provenance for r in self]),
                frame_rates=np.array([r.frame_rate for r in self]),
                nframe=np.array(frames, np.int32), ncontact=np.array(contacts, np.int32),
                hand_poses=np.concatenate([_packed(r.hand_poses) for r in self]),
                object_poses=np.concatenate([_packed(r.object_poses) for r in self]),
                phases=phases.astype(np.uint8),
                contact_bones=np.concatenate([r.contact_bones for r in self]).astype(np.uint8),
                **entries,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path | None = None) -> GraspDatabase:
        """Read what `save` wrote; without a path, the database that comes with handtrack.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is no database of a known format, or breaks its rules.
        """
        path = Path(path) if path is not None else artifact_path("data/grasps.npz")
        if not path.is_file():
            raise MissingFileError(f"no grasp database at {path}")
        try:
            with np.load(path, allow_pickle=False) as file:
                version = int(file["format_version"])
                if version != FORMAT_VERSION:
                    raise ValueError(f"format {version}; this version reads {FORMAT_VERSION}")
                return cls(tuple(_unpacked(dict(file))))
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is no grasp database: {error}") from error


def _units(steps: ArrayLike, width: int) -> Float:
    """What one unit of each entry of a pose is, shape (width,)."""
    return np.repeat(np.asarray(steps, np.float64), (3, 4, width - 7))


def _packed(poses: Float) -> NDArray[np.int16]:
    """Poses as whole numbers; from the second frame on, differences (exact when summed)."""
    poses = poses.copy()
    # Quaternions without jumps of sign have small differences.
    flips = np.sign((poses[1:, 3:7] * poses[:-1, 3:7]).sum(1) + 1e-12)
    poses[1:, 3:7] *= np.cumprod(flips)[:, None]
    whole = np.round(poses / _units(STEPS, poses.shape[1]))
    if np.abs(whole).max() > 32767:
        raise InputError("a pose is too far from the object's rest to store: the limit is 1.6 m")
    return np.diff(whole, axis=0, prepend=0).astype(np.int16)


def _poses(packed: NDArray[np.int16], steps: ArrayLike) -> Float:
    poses = np.cumsum(packed.astype(np.int64), axis=0) * _units(steps, packed.shape[1])
    poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
    return poses


def _unpacked(data: dict[str, NDArray]) -> Iterator[GraspRecording]:
    frames = np.cumsum(data["nframe"])[:-1]
    contacts = np.cumsum(data["ncontact"])[:-1]
    names = np.array(PHASES)
    per_frame = [np.split(data[name], frames) for name in ("hand_poses", "object_poses", "phases")]
    touching = {
        name: np.split(data[name], contacts)
        for name in ("contact_bones", "contact_local", "contact_points", "contact_normals")
    }
    for k, (hands, things, phases) in enumerate(zip(*per_frame, strict=True)):
        yield GraspRecording(
            grip=str(data["grips"][k]), object=str(data["objects"][k]),
            trial=int(data["trials"][k]), provenance=str(data["provenances"][k]),
            frame_rate=float(data["frame_rates"][k]), hand_poses=_poses(hands, data["steps"]),
            object_poses=_poses(things, data["steps"]), phases=names[phases],
            contact_bones=touching["contact_bones"][k].astype(np.int64),
            **{
                name: touching[name][k].astype(np.float64)
                for name in ("contact_local", "contact_points", "contact_normals")
            },
        )  # fmt: skip
