"""What competes to explain a frame: the forest's candidates, refined, for a look at them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.segmentation import find_hand_regions, wrists_of
from handtrack.forest.artifact import Forest
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.tracking.candidates import CandidateSearch
from handtrack.tracking.hybrid import HybridConfig
from handtrack.tracking.result import HandResult
from handtrack.viewer.viewer import Hypotheses

SHOWN = 8
"""So many hypotheses at most; more would hide each other."""


class HypothesisFinder:
    """Searches single frames as the hybrid tracker does in doubt, beside the tracking itself.

    The tracker looks for candidates only when it doubts, and keeps none; this shows them for any
    frame and any tracker, without an influence on what is tracked.
    """

    def __init__(self, hand: ShapedHand, camera: Camera, *, device: str | None = None) -> None:
        """Allocate.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            device: "cpu", "cuda:N" or None for the best there is.
        """
        config = HybridConfig()
        self._camera, self._hand = camera, hand
        self._search = CandidateSearch(
            hand, camera, Forest.load(config.forest), fit=config.search, places=1, device=device
        )

    def find(self, depth: NDArray[np.float32], result: HandResult) -> Hypotheses | None:
        """Candidates around the tracked hand, or in the likeliest region of the scene.

        Args:
            depth: Clean depth [m], shape (height, width).
            result: What the tracker found in it.

        Returns:
            The candidates, at most `SHOWN`; None where nothing has the size of a hand.
        """
        if result.hand is not self._hand:
            self._hand = result.hand
            self._search.resize(result.hand)
        if np.isfinite(result.pose).all():
            centre, wrists = result.keypoints.mean(axis=0, dtype=np.float64), None
        else:
            regions = find_hand_regions(depth, self._camera, max_regions=1)
            if not regions:
                return None
            centre, wrists = regions[0].centre, wrists_of(regions)
        found = self._search.run(depth, centre[None], wrists=wrists)
        best = found.best(found.errors, SHOWN, self._hand)
        return Hypotheses(
            keypoints=keypoints(self._hand, best.poses).astype(np.float32),
            errors=best.errors.astype(np.float32),
        )
