"""Spheres in the flesh along the finger bones, for telling when fingers touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import DISTAL_BONES, NBONE

Float = NDArray[np.float64]

ALONG_BONE = (0.15, 0.5, 0.85)
"""Places of a finger bone's spheres, as shares of its length."""

SHRINK = 0.9
"""Spheres are thinner than the finger: neighbours touch in a relaxed hand."""


def finger_spheres(hand: ShapedHand) -> tuple[NDArray[np.intp], Float, Float]:
    """Fit spheres to the skin of the fingers.

    Args:
        hand: One person's hand.

    Returns:
        Bone of each sphere, shape (nsphere,), centres in the bones' frames [m], shape (nsphere, 3),
        and radii [m], shape (nsphere,).
    """
    lengths = hand.bone_lengths
    bones, centres, radii = [], [], []
    for bone in range(1, NBONE):
        skin = hand.local_vertices[(hand.weight_bones == bone) & (hand.weights > 0.4)]
        end = lengths[bone] * (0.85 if bone in DISTAL_BONES else 1.0)
        for x in np.array(ALONG_BONE) * end:
            near = skin[np.abs(skin[:, 0] - x) < 0.25 * lengths[bone]]
            ring = (near if len(near) >= 4 else skin)[:, 1:]
            middle = 0.5 * (ring.min(0) + ring.max(0))
            bones.append(bone)
            centres.append([x, *middle])
            radii.append(SHRINK * np.median(np.linalg.norm(ring - middle, axis=1)))
    return np.array(bones, np.intp), np.array(centres), np.array(radii)
