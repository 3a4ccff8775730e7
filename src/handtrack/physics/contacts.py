"""What touches what in a simulation: contacts between the hand and one object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.transforms import cross_matrix

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
        bones = np.array(sorted(set(self.bones.tolist())), np.int64)
        mine = self.bones == bones[:, None]  # (npatch, ncontact)
        own = mine.astype(np.float64)
        press = (self.forces * self.normals).sum(1)
        # Untouched neighbours of a patch count a little, so that the centre always exists.
        share = own * (np.maximum(press, 0.0) + 1e-6)
        share /= share.sum(1, keepdims=True)
        normals, points = share @ self.normals, share @ self.points
        normals /= np.maximum(np.sqrt((normals * normals).sum(1, keepdims=True)), 1e-9)
        arms = self.points - own.T @ points
        moments = np.matmul(self.forces[:, None], cross_matrix(arms))[:, 0]
        return Contacts(
            bones=bones,
            points=points,
            normals=normals,
            depths=np.where(mine, self.depths, -np.inf).max(1, initial=-np.inf),
            forces=own @ self.forces,
            torsions=((own @ moments) * normals).sum(1) + own @ self.torsions,
        )
