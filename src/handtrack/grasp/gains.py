"""Gains of the servos that track the reference motion (thesis Table III.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.skeleton import FINGERS, NBONE, finger_of_bone

Float = NDArray[np.float64]

FINGER_STIFFNESS: tuple[tuple[float, float, float], ...] = (
    (10.0, 8.0, 4.0), (4.0, 3.0, 2.0), (4.0, 4.0, 2.0), (4.0, 3.0, 2.0), (4.0, 3.0, 2.0),
)  # fmt: skip
"""K_p of the first, second and third joint of each finger [N m/rad]."""

FINGER_DAMPING: tuple[tuple[float, float, float], ...] = (
    (0.3, 0.2, 0.4), (0.2, 0.1, 0.1), (0.4, 0.1, 0.1), (0.4, 0.1, 0.1), (0.4, 0.1, 0.1),
)  # fmt: skip
"""K_d of the same joints [N m s/rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Stiffness and damping of the hand's and the object's servos; the defaults are Table III.1.

    The table belongs to another simulator. The hand's figures hold here as they stand, since the
    servo is solved implicitly (`controller`). The object's rotation is the one exception: the
    table's 5 N m/rad would answer five degrees with 0.4 N m, for which a pad 25 mm from the centre
    must press with 17 N.
    """

    root_translation: tuple[float, float] = (400.0, 50.0)
    """K_p [N/m] and K_d [N s/m] of the palm's place."""
    root_rotation: tuple[float, float] = (600.0, 50.0)
    """K_p [N m/rad] and K_d [N m s/rad] of the palm's orientation."""
    finger_stiffness: tuple[tuple[float, float, float], ...] = FINGER_STIFFNESS
    finger_damping: tuple[tuple[float, float, float], ...] = FINGER_DAMPING
    finger_scale: float = 1.0
    """Factor on the fingers' stiffness and damping."""
    object_translation: tuple[float, float] = (5.0, 0.5)
    """K_p [N/m] and K_d [N s/m] of the object's virtual force (Eq. III.22)."""
    object_rotation: tuple[float, float] = (0.1, 0.005)
    """K_p [N m/rad] and K_d [N m s/rad] of the object's virtual torque; the table has 5.0, 0.5."""

    def __post_init__(self) -> None:
        for name in ("finger_stiffness", "finger_damping"):
            if np.shape(getattr(self, name)) != (len(FINGERS), 3):
                raise InputError(f"Gains.{name} needs three numbers for each of the five fingers")
        values = (
            *self.root_translation, *self.root_rotation, *self.object_translation,
            *self.object_rotation, self.finger_scale, *np.ravel(self.finger_stiffness),
            *np.ravel(self.finger_damping),
        )  # fmt: skip
        if not all(np.isfinite(value) and value >= 0.0 for value in values):
            raise InputError("Gains: every gain must be a number of at least 0")

    def of_hand(self, dof_bones: NDArray[np.int64]) -> tuple[Float, Float]:
        """K_p and K_d of each degree of freedom of a hand.

        Args:
            dof_bones: Bone that each one moves, the palm's six first (`HandLayout.bone_dofs`).

        Returns:
            Two vectors, shape (nhanddof,).
        """
        both = []
        for k, table in enumerate((self.finger_stiffness, self.finger_damping)):
            root = [self.root_translation[k]] * 3 + [self.root_rotation[k]] * 3
            by_bone = [0.0] + [
                self.finger_scale * table[finger_of_bone(bone)][(bone - 1) % 3]
                for bone in range(1, NBONE)
            ]
            both.append(np.array(root + [by_bone[bone] for bone in dof_bones[6:]]))
        return both[0], both[1]
