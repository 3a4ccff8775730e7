"""The regressor alone, frame by frame: the heaviest mode of the most plausible region (II.6.3)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.segmentation import find_hand_regions
from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.forest.artifact import Forest
from handtrack.forest.cascade import Cascade
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.tracking.stage_clock import StageClock
from handtrack.tracking.stepper import Estimate


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscriminativeConfig:
    """Settings of the discriminative tracker."""

    forest: str | None = None
    """File of the forest; the one that comes with handtrack when None."""
    score: FitConfig = field(default_factory=lambda: replace(FitConfig(), iterations=0))
    """How the depth error is measured; nothing is refined."""
    lost_error: float = 0.03
    """Depth error above which the hand counts as lost [m]; regression is coarse."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if self.score.iterations:
            raise InputError(
                f"score.iterations is {self.score.iterations}; expected 0: nothing is refined here"
            )
        if not 0 < self.lost_error <= self.score.score_cap:
            raise InputError(
                f"lost_error is {self.lost_error}; expected up to score_cap {self.score.score_cap}"
            )

    def make(
        self, hand: ShapedHand, camera: Camera, *, known_shape: bool, device: str | None,
        seed: int, graph: bool,
    ) -> TrackerDiscriminative:  # fmt: skip
        """Allocate the method; see `TrackerConfig`."""
        del known_shape, seed  # the hand is taken as it is, and nothing is random
        return TrackerDiscriminative(hand, camera, config=self, device=device, graph=graph)


class TrackerDiscriminative:
    """Regresses the pose of every frame anew; the last one only tells where to look."""

    automatic = True

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        config: DiscriminativeConfig | None = None,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate for one hand and camera.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self.config = config if config is not None else DiscriminativeConfig()
        self._hand, self._camera = hand, camera
        self._cascade = Cascade(
            Forest.load(self.config.forest), [hand.as_right()], camera, side=hand.side,
            device=device, graph=graph,
        )  # fmt: skip
        self._score = Fitter([hand], camera, config=self.config.score, device=device, graph=graph)
        for _ in range(2):
            self._regress(np.zeros(camera.shape, np.float32), np.array([0.0, 0.0, 0.5]))
        self.start(None)

    @property
    def started(self) -> bool:
        """Whether there is a pose to go on from."""
        return self._pose is not None

    def start(self, pose: NDArray[np.float64] | None) -> None:
        """Look around a pose first, shape (28,), or in the whole scene."""
        self._pose = pose

    def forget(self) -> None:
        """Start from nothing; see `Stepper`."""
        self.start(None)

    def step(
        self, depth: NDArray[np.float32], *, fallback: NDArray[np.float64] | None = None
    ) -> Estimate:
        """Find the hand in the next frame; see `Stepper`."""
        del fallback
        clock = StageClock()
        if self._pose is not None:
            centre = keypoints(self._hand, self._pose).mean(axis=0)
        else:
            regions = find_hand_regions(depth, self._camera, max_regions=1)
            if not regions:
                return Estimate(
                    pose=None, depth_error=np.nan, found=False,
                    problem="nothing in view has the size of a hand",
                )  # fmt: skip
            centre = regions[0].centre
        pose, error = self._regress(depth, centre)
        found = error < self.config.lost_error
        self._pose = pose if found else None
        clock.lap("regress")
        return Estimate(pose=pose, depth_error=error, found=found, timings=clock.spans)

    def find_all(self, depths: NDArray[np.float32]) -> list[Estimate]:
        """The hand in independent frames; see `Finder`."""
        estimates = []
        for depth in depths:
            self.forget()
            estimates.append(self.step(depth))
        return estimates

    def _regress(
        self, depth: NDArray[np.float32], centre: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """Pose, shape (28,), of the heaviest mode, and its depth error [m]."""
        self._cascade.load(depth, centre[None])
        palms, _ = self._cascade.run_palms()
        pose = self._cascade.run_fingers(palms)[0, 0]
        self._score.load_depth(depth)
        self._score.place(keypoints(self._hand, pose).mean(axis=0))
        self._score.set_poses(pose)
        self._score.run()
        return pose, float(self._score.errors[0])
