"""Spheres inside the fingers and the palm, for the self-collision term."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import DISTAL_BONES, NBONE, finger_of_bone

PER_BONE = 3
"""Spheres along each finger bone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionSpheres:
    """Spheres of one or several hands on a device."""

    bones: wp.array
    """Bone of each sphere, shape (nsphere,)."""
    centres: wp.array
    """Centres in the bones' frames [m], shape (nhand, nsphere) vec3."""
    radii: wp.array
    """Radii [m], shape (nhand, nsphere)."""
    pairs: wp.array
    """Spheres of different fingers, which may not overlap, shape (npair, 2)."""

    @property
    def count(self) -> int:
        """Number of spheres per hand."""
        return self.bones.shape[0]

    @classmethod
    def build(cls, hands: Sequence[ShapedHand], device: wp.Device) -> CollisionSpheres:
        """Fit spheres to each hand's skin, centred in the flesh along every finger bone."""
        bones = np.repeat(np.arange(1, NBONE), PER_BONE)
        fitted = [_fit_spheres(hand) for hand in hands]
        fingers = np.array([finger_of_bone(int(b)) for b in bones])
        first, second = np.triu_indices(len(bones), 1)
        apart = fingers[first] != fingers[second]
        # The metacarpal of the thumb lies in the palm's flesh beside the index' root.
        rooted = (bones[first] == 1) | (bones[second] == 1)
        pairs = np.stack([first, second], 1)[apart & ~rooted]
        return cls(
            bones=wp.array(bones.astype(np.int32), dtype=int, device=device),
            centres=wp.array(
                np.stack([c for c, _ in fitted]).astype(np.float32), dtype=wp.vec3, device=device
            ),
            radii=wp.array(
                np.stack([r for _, r in fitted]).astype(np.float32), dtype=float, device=device
            ),
            pairs=wp.array(pairs.astype(np.int32), dtype=int, device=device),
        )


def _fit_spheres(hand: ShapedHand) -> tuple[np.ndarray, np.ndarray]:
    """Centres, shape (nsphere, 3), and radii, shape (nsphere,), in the bones' frames."""
    lengths = hand.bone_lengths
    centres, radii = [], []
    for bone in range(1, NBONE):
        mine = (hand.weight_bones == bone) & (hand.weights > 0.4)
        skin = hand.local_vertices[mine]
        end = lengths[bone] * (0.85 if bone in DISTAL_BONES else 1.0)
        for x in np.linspace(0.15, 0.85, PER_BONE) * end:
            near = skin[np.abs(skin[:, 0] - x) < 0.25 * lengths[bone]]
            ring = (near if len(near) >= 4 else skin)[:, 1:]
            middle = 0.5 * (ring.min(0) + ring.max(0))
            centres.append([x, *middle])
            # Slightly thinner than the finger: neighbours touch in a relaxed hand.
            radii.append(0.9 * np.median(np.linalg.norm(ring - middle, axis=1)))
    return np.array(centres), np.array(radii)
