"""Model-based tracking: refine the previous pose on each frame (thesis II.5.2)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NV
from handtrack.priors.gaussian import GaussianPrior
from handtrack.tracking.best_fit import fit_best
from handtrack.tracking.doubt import Doubt
from handtrack.tracking.rescue import restart_poses
from handtrack.tracking.stage_clock import StageClock
from handtrack.tracking.stepper import Estimate
from handtrack.transforms import apply_increment, pose_difference


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelBasedConfig:
    """Settings of the model-based tracker."""

    fit: FitConfig = field(default_factory=FitConfig)
    """The fit of one frame."""
    velocity: float = 1.0
    """Share of the last motion that a second hypothesis repeats; 0 leaves that hypothesis out."""
    rescue_rows: int = 16
    """Random restarts tried on a frame that is explained badly; 0 switches them off."""
    rescue_error: float = 0.008
    """Depth error above which restarts are tried [m]."""
    rescue_jump: float = 1.3
    """Restarts are tried on every frame whose depth error is above so much of its running level."""
    rescue_period: int = 10
    """Frames between tries when the depth error is high but steady, as with a wrong shape."""
    rescue_gain: float = 0.9
    """A restart replaces the tracked pose when its depth error is below so much of the tracked
    one's."""
    lost_error: float = 0.02
    """tau of Eq. II.19: depth error above which the hand counts as lost [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not 0 <= self.velocity <= 2:
            raise InputError(f"velocity is {self.velocity}; expected 0 to 2")
        if self.rescue_period < 1 or self.rescue_jump < 1:
            raise InputError(
                f"rescue_period and rescue_jump are {self.rescue_period} and {self.rescue_jump};"
                " expected at least 1"
            )
        if self.rescue_rows < 0 or not 0 < self.rescue_gain <= 1 or self.rescue_error <= 0:
            raise InputError(
                f"rescue_rows, rescue_gain, rescue_error are {self.rescue_rows},"
                f" {self.rescue_gain}, {self.rescue_error}; expected >= 0, 0 to 1 and > 0"
            )
        if not 0 < self.lost_error <= self.fit.score_cap:
            raise InputError(
                f"lost_error is {self.lost_error}; expected up to score_cap {self.fit.score_cap}"
            )

    def make(
        self, hand: ShapedHand, camera: Camera, *, known_shape: bool, device: str | None,
        seed: int, graph: bool,
    ) -> TrackerModelBased:  # fmt: skip
        """Allocate the method; see `TrackerConfig`."""
        del known_shape  # the hand is taken as it is
        return TrackerModelBased(hand, camera, config=self, device=device, seed=seed, graph=graph)


THESIS_TRACKER = ModelBasedConfig(fit=THESIS, velocity=0.0, rescue_rows=0)
"""The thesis' model-based tracking: Eq. II.21 alone, from the previous pose."""


class TrackerModelBased:
    """Follows one hand from a given first pose."""

    automatic = False

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        config: ModelBasedConfig | None = None,
        device: str | None = None,
        seed: int = 0,
        graph: bool = True,
    ) -> None:
        """Allocate for one hand and camera.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            seed: Seed of the random restarts.
            graph: False launches eagerly, for debugging.
        """
        self.config = config if config is not None else ModelBasedConfig()
        self._hand = hand
        prior = GaussianPrior.load() if self.config.fit.prior_weight > 0 else None
        self._nhyp = 2 if self.config.velocity > 0 else 1

        def fitter(rows: int) -> Fitter:
            return Fitter(
                [hand], camera, config=self.config.fit, nhyp=rows, device=device, prior=prior,
                graph=graph,
            )  # fmt: skip

        self._fitter = fitter(self._nhyp)
        self._rescuer = fitter(self.config.rescue_rows) if self.config.rescue_rows else None
        # Compile and capture now, not on the first frame or the first loss.
        for used in (self._fitter, self._rescuer):
            if used is not None:
                used.warm_up()
        self._seed = seed
        self._doubt = Doubt(
            error=self.config.rescue_error, jump=self.config.rescue_jump,
            period=self.config.rescue_period,
        )  # fmt: skip
        self.start(None)

    @property
    def started(self) -> bool:
        """Whether there is a pose to go on from."""
        return self._pose is not None

    def start(self, pose: NDArray[np.float64] | None) -> None:
        """Go on from a pose at rest, shape (28,), or from nothing."""
        self._pose: NDArray[np.float64] | None = None
        if pose is not None:
            self._pose = np.array(pose, np.float64)
        self._motion = np.zeros(NV)
        self._rng = np.random.default_rng(self._seed)
        self._doubt.forget()

    def forget(self) -> None:
        """Start from nothing; see `Stepper`."""
        self.start(None)

    def reshape(self, hand: ShapedHand, *, known_shape: bool) -> None:
        """Go on with another hand; see `Reshapable`."""
        del known_shape
        self._hand = hand
        for used in (self._fitter, self._rescuer):
            if used is not None:
                used.resize([hand])
        # Depth errors of another hand do not compare.
        self._doubt.forget_level()

    def step(
        self, depth: NDArray[np.float32], *, fallback: NDArray[np.float64] | None = None
    ) -> Estimate:
        """Follow the hand into the next frame.

        Args:
            depth: Clean depth image [m], shape (height, width).
            fallback: Pose to try beside the last one instead of the predicted one, shape (28,); for
                frames after a loss, whose motion means nothing.

        Returns:
            The best hypothesis.
        """
        clock = StageClock()
        pose = self._pose
        assert pose is not None, "start first"
        if fallback is None:
            fallback = apply_increment(pose, self.config.velocity * self._motion)
        starts = np.stack([pose, fallback][: self._nhyp])
        clock.lap("predict")
        found, error, information = fit_best(self._fitter, self._hand, depth, starts)
        clock.lap("fit")
        if self._rescuer is not None and self._doubt.arises(error):
            restarts = restart_poses(self._hand, found, self.config.rescue_rows, self._rng)
            other, other_error, other_information = fit_best(
                self._rescuer, self._hand, depth, restarts
            )
            if other_error < self.config.rescue_gain * error:
                found, error, information = other, other_error, other_information
        self._doubt.remember(error)
        self._motion = pose_difference(found, pose)
        self._pose = found
        clock.lap("rescue")
        return Estimate(
            pose=found,
            depth_error=error,
            found=error < self.config.lost_error,
            information=information,
            timings=clock.spans,
        )
