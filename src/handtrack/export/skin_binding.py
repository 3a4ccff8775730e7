"""Rest mesh and inverse bind matrices with which plain linear blend skinning gives the hand's skin.

A hand keeps each vertex once per bone that moves it, since Eq. II.3 stretches it along each bone by
that bone's own scale. Formats for skinned meshes keep one vertex and a matrix per bone. The two are
the same: a bone's copies are an affine image of the palm's copies, so a matrix that also stretches
takes the place of the rigid one, and v = sum_j w_j T_j B_j v_rest is Eq. II.9 without a remainder.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]


def bind(hand: ShapedHand) -> tuple[Float, Float]:
    """Rest mesh and inverse bind matrices.

    Args:
        hand: One person's hand.

    Returns:
        Vertices of the rest mesh in the palm frame [m], shape (nvert, 3), and matrices B_j that
        take them to the frame of bone j, shape (16, 4, 4), last row 0 0 0 1.
    """
    rest = np.full((hand.nvert, 3), np.nan)
    rows, slots = np.nonzero(hand.weight_bones == 0)
    rest[rows] = hand.local_vertices[rows, slots]
    matrices = np.tile(np.eye(4), (NBONE, 1, 1))
    # Along a finger: where its first bone meets the palm, the vertices have copies in both.
    for bone in range(1, NBONE):
        rows, slots = np.nonzero(hand.weight_bones == bone)
        local = hand.local_vertices[rows, slots]
        known = np.isfinite(rest[rows, 0])
        ones = np.ones((int(known.sum()), 1))
        affine = np.linalg.lstsq(np.hstack([rest[rows[known]], ones]), local[known], rcond=None)[0]
        matrices[bone, :3] = affine.T
        new = rows[~known]
        rest[new] = (local[~known] - affine[3]) @ np.linalg.inv(affine[:3])
    return rest, matrices
