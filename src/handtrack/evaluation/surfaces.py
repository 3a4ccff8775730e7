"""Distance between the surfaces of two hands."""

from __future__ import annotations

import numpy as np

from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.surface_distance import surface_distance


def rest_surface_distance(first: ShapedHand, second: ShapedHand) -> float:
    """Mean distance between two hands' skins without forearm, both ways, in the rest pose [m].

    Palm frames and joint angles are the same; nothing is aligned beyond that.
    """
    pose = np.zeros(28)
    pose[3] = 1.0
    pose[7:] = first.rest_angles
    skins = [skin(hand, pose) for hand in (first, second)]
    distances = [
        surface_distance(skins[k][~hand.stub_vertices], skins[1 - k], hand.faces).mean()
        for k, hand in enumerate((first, second))
    ]
    return float(np.mean(distances))
