"""What the tracking loop shows and to whom: a `View` of one frame, a `Viewer` that draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.tracking.result import HandResult


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypotheses:
    """Poses that compete to explain one frame, the best first."""

    keypoints: NDArray[np.float32]
    """Their keypoints [m], shape (n, 21, 3), camera frame."""
    errors: NDArray[np.float32]
    """Their depth errors E_d of Eq. II.19 [m], shape (n,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """All that can be shown of one frame and of the loop at that time; never changed later."""

    frame: DepthFrame
    """The depth image."""
    hand: HandResult
    """What the tracker found in it."""
    tracker: str
    """Name of the tracker."""
    rate: float
    """Frames tracked per second, waiting included [1/s]; NaN while it is not known."""
    count: int
    """Frames tracked since the loop began, this one included."""
    length: int | None = None
    """Number of frames of a recording, None without an end."""
    paused: bool = False
    """Whether the loop waits for the user."""
    recording: bool = False
    """Whether frames are being recorded."""
    dropped: int = 0
    """Frames of a live source that came while the tracker was busy."""
    delay: float = np.nan
    """Time from the arrival of a live frame to this view [s]; NaN in recordings."""
    notice: str = ""
    """What the user should know, such as that the camera is unplugged."""
    hypotheses: Hypotheses | None = None
    """Candidates for this frame, None unless they were asked for."""


class Viewer(Protocol):
    """Whoever is shown views. Both methods return at once: the tracking loop waits for nobody."""

    def show(self, view: View) -> None:
        """Show a view, now or when there is time; a newer one may take its place before that."""
        ...

    def close(self) -> None:
        """Let go of everything; nothing is shown any more."""
        ...


class NullViewer:
    """Shows nothing to nobody, so that loops need not ask whether there is a viewer."""

    def show(self, view: View) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
