"""What every tracker does with one frame, whatever its method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.model import ShapedHand


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a tracker finds in one frame."""

    pose: NDArray[np.float64] | None
    """Pose, shape (28,); None when nothing in view can be a hand."""
    depth_error: float
    """E_d of Eq. II.19 [m]; NaN without a pose."""
    found: bool
    """The flag delta of Eq. II.19: the pose explains the depth."""
    problem: str | None = None
    """Why it was not found."""
    hand: ShapedHand | None = None
    """The hand as the tracker takes it to be by now; None when it is still the one given."""
    timings: dict[str, float] = field(default_factory=dict)
    """Time spent per stage [ms]."""
    information: FitInformation | None = None
    """What the fit of that pose knew of it, for `HandResult.keypoint_std`; None when not known."""


class Stepper(Protocol):
    """A tracking method: memory over frames, one estimate per frame."""

    automatic: bool
    """Whether it finds the hand by itself; the others need `start(pose)`."""

    @property
    def started(self) -> bool:
        """Whether there is a pose to go on from."""
        ...

    def start(self, pose: NDArray[np.float64] | None) -> None:
        """Go on from a pose at rest, shape (28,), or from nothing."""
        ...

    def forget(self) -> None:
        """Start from nothing, as if new."""
        ...

    def step(
        self, depth: NDArray[np.float32], *, fallback: NDArray[np.float64] | None = None
    ) -> Estimate:
        """Find the hand in the next frame.

        Args:
            depth: Clean depth image [m], shape (height, width).
            fallback: After a loss, the last pose that explained a frame, shape (28,).
        """
        ...


@runtime_checkable
class Finder(Protocol):
    """A method that finds hands in frames without memory."""

    def find_all(self, depths: NDArray[np.float32]) -> list[Estimate]:
        """The hand in independent frames.

        Args:
            depths: Clean depth [m], shape (n, height, width).
        """
        ...


@runtime_checkable
class Reshapable(Protocol):
    """A method that can go on with a hand of another shape."""

    def reshape(self, hand: ShapedHand, *, known_shape: bool) -> None:
        """Go on with another hand of the same side.

        Args:
            hand: The hand.
            known_shape: Whether it is the person's own; else its size is still looked for by
                methods that do so.
        """
        ...


class TrackerConfig(Protocol):
    """Settings of a tracking method, which make the method."""

    def make(
        self, hand: ShapedHand, camera: Camera, *, known_shape: bool, device: str | None,
        seed: int, graph: bool,
    ) -> Stepper:  # fmt: skip
        """Allocate the method for one hand and camera.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            known_shape: Whether `hand` is the person's own, rather than the mean hand.
            device: "cpu", "cuda:N" or None for the best there is.
            seed: Seed of whatever is random.
            graph: False launches eagerly, for debugging.
        """
        ...
