"""How deep fingers sink into each other or into the palm, from spheres inside the skin (NumPy)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.model import ShapedHand, skeleton_frames
from handtrack.hand.skeleton import BASE_BONES, finger_of_bone
from handtrack.hand.spheres import SHRINK, finger_spheres

Float = NDArray[np.float64]

_ALONG_PALM = (0.35, 0.6, 0.82)


@dataclass(frozen=True, slots=True, kw_only=True)
class HandSpheres:
    """Spheres along the finger bones and in the palm of one hand."""

    hand: ShapedHand
    """The hand they were fitted to."""
    bones: NDArray[np.intp]
    """Bone of each sphere, shape (nsphere,)."""
    centres: Float
    """Centres in the bones' frames [m], shape (nsphere, 3)."""
    radii: Float
    """Radii [m], shape (nsphere,)."""
    pairs: NDArray[np.intp]
    """Spheres that may not overlap, shape (npair, 2)."""

    @classmethod
    def of(cls, hand: ShapedHand) -> HandSpheres:
        """Fit spheres to a hand's skin."""
        bones, centres, radii = finger_spheres(hand)
        palm_centres, palm_radii = _palm_spheres(hand)
        bones = np.concatenate([bones, np.zeros(len(palm_radii), np.intp)])
        first, second = np.triu_indices(len(bones), 1)
        finger = np.array([finger_of_bone(int(b)) for b in bones])
        apart = finger[first] != finger[second]
        # The thumb's metacarpal lies in the flesh of the palm; so do the roots of the fingers, and
        # the ball of the thumb moves with the thumb's second bone.
        rooted = (bones[first] == 1) | (bones[second] == 1)
        near_palm = np.isin(bones, [2, *BASE_BONES])
        rooted |= (finger[first] == -1) & near_palm[second]
        rooted |= (finger[second] == -1) & near_palm[first]
        return cls(
            hand=hand,
            bones=bones,
            centres=np.concatenate([centres, palm_centres]),
            radii=np.concatenate([radii, palm_radii]),
            pairs=np.stack([first, second], 1)[apart & ~rooted],
        )

    def overlaps(self, angles: ArrayLike) -> Float:
        """Overlap of each pair [m], shape (..., npair), negative: apart.

        Args:
            angles: Joint angles [rad], shape (..., 21).
        """
        hand = self.hand
        rotations, origins = skeleton_frames(
            hand.bone_rotations, hand.bone_origins, hand.angle_axes, np.asarray(angles, np.float64)
        )
        turned = np.einsum("...sij,sj->...si", rotations[..., self.bones, :, :], self.centres)
        places = turned + origins[..., self.bones, :]
        first, second = self.pairs.T
        apart = np.linalg.norm(places[..., first, :] - places[..., second, :], axis=-1)
        return self.radii[first] + self.radii[second] - apart

    def penetration(self, angles: ArrayLike) -> Float:
        """Deepest overlap of fingers with each other or the palm [m], shape (...), at least 0."""
        return np.maximum(self.overlaps(angles).max(axis=-1), 0.0)


def _palm_spheres(hand: ShapedHand) -> tuple[Float, Float]:
    """Centres [m], palm frame, and radii [m] of spheres along the fingers' metacarpals."""
    skin = hand.local_vertices[(hand.weight_bones == 0) & (hand.weights > 0.6)]
    centres, radii = [], []
    for base in BASE_BONES[1:]:
        for share in _ALONG_PALM:
            x, _, z = share * hand.bone_origins[base]
            reach = 0.012
            near = skin[np.hypot(skin[:, 0] - x, skin[:, 2] - z) < reach]
            while len(near) < 6 or np.ptp(near[:, 1]) < 0.01:  # coarse mesh: look farther
                reach += 0.004
                near = skin[np.hypot(skin[:, 0] - x, skin[:, 2] - z) < reach]
            low, high = near[:, 1].min(), near[:, 1].max()
            centres.append([x, 0.5 * (low + high), z])
            radii.append(SHRINK * 0.5 * (high - low))
    return np.array(centres), np.array(radii)
