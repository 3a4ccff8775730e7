"""What touches what in a simulation: contacts between the hand and one object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Contacts:
    """Contacts of the hand with one object in one step, world frame."""

    bones: NDArray[np.int64]
    """Bone of each contact, shape (ncontact,)."""
    points: Float
    """Where they touch [m], shape (ncontact, 3)."""
    normals: Float
    """Unit normals into the object, shape (ncontact, 3)."""
    depths: Float
    """How deep the solids overlap [m], negative for a gap, shape (ncontact,)."""
    forces: Float
    """Forces on the object [N], shape (ncontact, 3)."""
    torsions: Float
    """Torques on the object about the normals [N m], shape (ncontact,)."""

    def __len__(self) -> int:
        return len(self.bones)

    def patches(self) -> Contacts:
        """One contact per bone: the sum of its forces at their centre of pressure."""
        bones = np.unique(self.bones)
        rows = []
        for bone in bones:
            own = self.bones == bone
            press = np.maximum(np.einsum("ni,ni->n", self.forces[own], self.normals[own]), 0.0)
            # Untouched neighbours of a patch count a little, so that the centre always exists.
            share = press + 1e-6
            share = share / share.sum()
            normal = share @ self.normals[own]
            point = share @ self.points[own]
            normal = normal / max(float(np.linalg.norm(normal)), 1e-9)
            arm = self.points[own] - point
            twist = np.cross(arm, self.forces[own]).sum(0) @ normal + self.torsions[own].sum()
            rows.append(
                (point, normal, self.depths[own].max(), self.forces[own].sum(0), float(twist))
            )
        columns = list(zip(*rows, strict=True)) if rows else [(), (), (), (), ()]
        return Contacts(
            bones=bones,
            points=np.array(columns[0]).reshape(-1, 3),
            normals=np.array(columns[1]).reshape(-1, 3),
            depths=np.array(columns[2], np.float64),
            forces=np.array(columns[3]).reshape(-1, 3),
            torsions=np.array(columns[4], np.float64),
        )
