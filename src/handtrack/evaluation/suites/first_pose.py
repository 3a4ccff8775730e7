"""First poses as an automatic tracker finds them, for trackers that do not start by themselves.

The thesis starts its baselines from what the hybrid tracker finds in the first frame (II.6.2.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]


def found_starts(
    finder: HandTracker, frames: Sequence[DepthFrame], takes: Sequence[int]
) -> dict[int, Float]:
    """Pose of the hand in the first frame of each take, found without memory.

    Where it is not found in the first frame, the frames after it are tried, up to the end of the
    take: a tracker that waits for its start loses those frames.

    Args:
        finder: A tracker that starts by itself; its past is forgotten.
        frames: The frames.
        takes: Place among the frames where each take begins, ascending.

    Returns:
        Place among the frames -> pose found there, shape (28,).

    Raises:
        InputError: The tracker does not start by itself.
    """
    if not finder.automatic:
        raise InputError("first poses can only be found by a tracker that starts by itself")
    found = {}
    for first, end in zip(takes, [*takes[1:], len(frames)], strict=True):
        for place in range(first, end):
            finder.reset()
            result = finder.track(frames[place].depth)
            if result.state is TrackState.TRACKING:
                found[place] = result.pose
                break
    return found
