"""What tracking one frame gives: a frozen host copy, safe to keep."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from handtrack.fitting.uncertainty import FitInformation, keypoint_deviation
from handtrack.hand.kinematics import keypoints, skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.side import Side
from handtrack.hand.skeleton import NKEYPOINT


class TrackState(enum.Enum):
    """How far a result can be trusted."""

    TRACKING = "tracking"
    """The pose explains this frame's depth, as it did the frame before."""
    RECOVERED = "recovered"
    """The pose explains this frame's depth after frames that were lost."""
    LOST = "lost"
    """The depth is not explained; the pose is the last one that was."""
    NO_HAND = "no_hand"
    """There was no hand to be seen yet, or none was ever started; keypoints are NaN."""

    @property
    def sure(self) -> bool:
        """Whether the tracker vouches for the pose: it explains this frame's depth."""
        return self in (TrackState.TRACKING, TrackState.RECOVERED)


@dataclass(frozen=True, kw_only=True)
class HandResult:
    """Pose of one hand in one frame."""

    state: TrackState
    """Whether to trust it."""
    side: Side
    """Which hand."""
    pose: NDArray[np.float64]
    """Translation [m] 3, unit quaternion w x y z, joint angles [rad] 21; shape (28,). With NO_HAND
    all NaN."""
    depth_error: float
    """Mean capped depth difference between the rendered hand and the image [m] (Eq. II.19); NaN
    without one."""
    hand: ShapedHand = field(repr=False)
    """The hand whose pose it is."""
    problem: str | None = None
    """Why the frame could not be used, None for a good frame."""
    timings: dict[str, float] = field(default_factory=dict, repr=False)
    """Time spent per stage [ms]."""
    information: FitInformation | None = field(default=None, repr=False)
    """What the fit of the pose knew of it; None when not known."""

    @cached_property
    def keypoints(self) -> NDArray[np.float32]:
        """The 21 keypoints [m], shape (21, 3), camera frame; NaN with NO_HAND."""
        return keypoints(self.hand, self.pose).astype(np.float32)

    @cached_property
    def keypoint_std(self) -> NDArray[np.float32]:
        """One sigma of each keypoint [m], shape (21,), as a distance in space.

        NaN where it is not known: LOST, NO_HAND, or a tracker that does not tell. See
        `handtrack.fitting.uncertainty` for what lies within it.
        """
        if self.information is None:
            return np.full(NKEYPOINT, np.nan, np.float32)
        return keypoint_deviation(self.hand, self.pose, self.information).astype(np.float32)

    @cached_property
    def vertices(self) -> NDArray[np.float32]:
        """Skin [m], shape (nvert, 3), camera frame; NaN with NO_HAND."""
        return skin(self.hand, self.pose).astype(np.float32)

    @property
    def faces(self) -> NDArray[np.int32]:
        """Triangles of the skin, shape (nface, 3)."""
        return self.hand.faces
