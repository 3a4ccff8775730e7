"""The plan of a grasp: motions of hand and object, phase by phase, and where they touch."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.grasp.phases import phase_numbers
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]

FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspPlan:
    """A kinematic grasping motion, which `grasp.simulation.simulate` carries out under physics."""

    grip: str
    """Name of the grip mode (`grasp.taxonomy`)."""
    times: Float
    """Time of each frame [s], rising, shape (nframe,)."""
    hand_poses: Float
    """Hand in the world, shape (nframe, 28)."""
    object_poses: Float
    """Object in the world: centre of mass [m] and quaternion, shape (nframe, 7)."""
    phases: NDArray[np.str_]
    """Phase of each frame, names of `phases.PHASES` in their order, shape (nframe,)."""
    contact_bones: NDArray[np.int64]
    """Bone of each contact, shape (ncontact,)."""
    contact_local: Float
    """Place of each contact on the hand [m], its bone's frame, shape (ncontact, 3)."""
    contact_points: Float
    """Place of each contact on the object [m], the object's frame, shape (ncontact, 3)."""
    contact_normals: Float
    """Outward normals of the object there, shape (ncontact, 3)."""
    feasible: bool
    """Whether the contacts can carry the object's weight (`grasp.feasibility`)."""
    costs: dict[str, float] = field(default_factory=dict)
    """Weighted terms of the objective (`grasp.objective`) of the closing motion."""

    def __post_init__(self) -> None:
        """Check shapes and order.

        Raises:
            InputError: The arrays do not fit together.
        """
        count, touching = len(self.times), len(self.contact_bones)
        wanted = {
            "times": (count,), "hand_poses": (count, 28), "object_poses": (count, 7),
            "phases": (count,), "contact_bones": (touching,), "contact_local": (touching, 3),
            "contact_points": (touching, 3), "contact_normals": (touching, 3),
        }  # fmt: skip
        for name, shape in wanted.items():
            given = np.shape(getattr(self, name))
            if given != shape:
                raise InputError(f"GraspPlan.{name} has shape {given}; expected {shape}")
        if count < 2 or not (np.diff(self.times) > 0).all():
            raise InputError("a plan needs at least two frames, and their times must rise")
        phase_numbers(self.phases, of="the plan")
        if touching and not 0 <= self.contact_bones.min() <= self.contact_bones.max() < NBONE:
            raise InputError(f"a contact is on a bone that does not exist; there are {NBONE}")
        if not np.isfinite(self.hand_poses).all() or not np.isfinite(self.object_poses).all():
            raise InputError("the poses of a plan hold numbers that are not finite")

    def of_phase(self, name: str) -> NDArray[np.intp]:
        """Numbers of the frames of a phase."""
        return np.flatnonzero(self.phases == name)

    @property
    def grasp_frame(self) -> int:
        """Number of the frame in which the hand has closed: the last one of the closing phase."""
        closing = self.of_phase("closing")
        return int(closing[-1]) if len(closing) else 0

    def save(self, path: str | Path) -> None:
        """Write to .npz."""
        entries = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "costs"}
        names = sorted(self.costs)
        with whole_file(Path(path)) as file:
            np.savez_compressed(
                file, format_version=FORMAT_VERSION, cost_names=np.array(names, np.str_),
                cost_values=np.array([self.costs[name] for name in names]), **entries,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> GraspPlan:
        """Read what `save` wrote.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is no plan.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"no grasp plan at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                version = int(data["format_version"])
                if version != FORMAT_VERSION:
                    raise ValueError(f"format {version}; this version reads {FORMAT_VERSION}")
                named = zip(data["cost_names"].tolist(), data["cost_values"].tolist(), strict=True)
                skipped = ("grip", "feasible", "costs")
                arrays = {f.name: data[f.name] for f in fields(cls) if f.name not in skipped}
                return cls(
                    grip=str(data["grip"]), feasible=bool(data["feasible"]), costs=dict(named),
                    **arrays,
                )  # fmt: skip
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is no grasp plan: {error}") from error
