"""The whole shape of a hand, found while it is tracked, and frozen when it is sure.

A few frames that together tell most about the shape are kept. Every some frames the shape takes one
step over all of them, as in `handtrack.fitting.shape_fitter`. The size comes first and from the
first frame, by `handtrack.tracking.size_probe`; the shape goes on from there, and the probe rests.

Shape adaptation while tracking is after Makris and Argyros, "Model-based 3D hand tracking with
on-line shape adaptation", BMVC 2015; keeping what is known of a shape and when to trust it, after
Tkach et al., "Online generative model personalization for hand tracking", SIGGRAPH Asia 2017.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.fitting.shape_certainty import ShapeCertainty
from handtrack.fitting.shape_config import ShapeFitConfig
from handtrack.fitting.shape_fitter import ShapeFitter
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.tracking.frame_choice import worth
from handtrack.tracking.result import HandResult, TrackState

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptionConfig:
    """Settings of shape adaption."""

    fit: ShapeFitConfig = field(default_factory=ShapeFitConfig)
    """The fit of the shape."""
    frames: int = 10
    """Frames that are kept."""
    least_frames: int = 3
    """Frames from which the shape is taken."""
    look_period: int = 4
    """Frames from one that may be kept to the next."""
    step_period: int = 8
    """Frames from one step of the shape to the next; between looks, so that no frame pays for
    both."""
    explained: float = 0.010
    """Depth error up to which a frame may be kept [m]."""
    sure: float = 0.0013
    """Mean deviation of the bones' lengths below which the shape is sure [m]."""
    settled: float = 0.0003
    """Largest change of a bone's length by a step that counts as none [m]."""
    whole_steps: int = 8
    """So many steps are taken whole; the n-th one after by this number over n, so that later frames
    refine what earlier ones found instead of replacing it."""
    settled_steps: int = 6
    """So many steps without change freeze a shape that is sure."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not 1 <= self.least_frames <= self.frames:
            raise InputError(
                f"least_frames is {self.least_frames}; expected 1 to frames, {self.frames}"
            )
        for name in ("look_period", "step_period", "explained", "sure", "settled",
                     "whole_steps", "settled_steps"):  # fmt: skip
            if getattr(self, name) <= 0:
                raise InputError(f"{name} is {getattr(self, name)}; expected above 0")


@dataclass(slots=True)
class _Kept:
    """A frame that is kept."""

    depth: NDArray[np.float32]
    pose: Float
    precision: Float
    """What it tells of the shape, shape (nshape, nshape)."""


class ShapeAdaption:
    """Follows a tracker's frames and finds the shape of its hand."""

    def __init__(
        self,
        model: HandModel,
        camera: Camera,
        *,
        side: str = "right",
        start: HandShape | None = None,
        config: AdaptionConfig | None = None,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            model: The parametric hand.
            camera: Camera of the depth images.
            side: "right" or "left".
            start: Shape to start from; the mean hand without.
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self.config = config if config is not None else AdaptionConfig()

        def fitter(images: int) -> ShapeFitter:
            made = ShapeFitter(
                model, camera, images=images, side=side, config=self.config.fit, device=device,
                graph=graph,
            )  # fmt: skip
            made.warm_up()
            return made

        self._fitter, self._looker = fitter(self.config.frames), fitter(1)
        self._unknowns = self._fitter.unknowns
        self._start = self._unknowns.vector(start if start is not None else HandShape())
        self.forget()

    def forget(self) -> None:
        """Start anew."""
        self._x = self._start.copy()
        self._kept: list[_Kept] = []
        self._count, self._steps, self._calm = 0, 0, 0
        self._certainty: ShapeCertainty | None = None
        self.frozen = False

    @property
    def begun(self) -> bool:
        """Whether the shape has been taken from frames."""
        return self._certainty is not None

    @property
    def shape(self) -> HandShape:
        """The shape by now, with its uncertainty once it was taken from frames."""
        shape = self._unknowns.shape(self._x)
        if self._certainty is None:
            return shape
        shape = self._unknowns.with_deviations(shape, self._certainty.deviations)
        return replace(shape, problem=self._certainty.problem)

    def watch(
        self, depth: NDArray[np.float32], result: HandResult, size: float
    ) -> ShapedHand | None:
        """Take a frame into account; most calls only count.

        Args:
            depth: Clean depth image [m], shape (height, width).
            result: What the tracker found in it.
            size: Scale of its hand, against the one that it was made with.

        Returns:
            The hand to go on with; None when it has not changed.
        """
        config = self.config
        if self.frozen or result.state is not TrackState.TRACKING:
            return None
        if not result.depth_error < config.explained:
            return None
        self._count += 1
        if not self.begun:
            self._x[0] = self._start[0] + np.log(size)
        if self._count % config.look_period == 1:
            self._look(depth, result.pose)
        elif self._count % config.step_period == 0 and len(self._kept) >= config.least_frames:
            return self._step()
        return None

    def _look(self, depth: NDArray[np.float32], pose: Float) -> None:
        """Keep a frame when it tells more than one of those that are kept."""
        told = self._looker.run(depth[None], pose[None], self._x, rounds=0)
        kept = _Kept(depth.copy(), told.poses[0], told.precisions[0])
        if len(self._kept) < self.config.frames:
            self._kept.append(kept)
            return
        prior = self._fitter.prior_precision
        pools = [[*self._kept[:k], *self._kept[k + 1 :], kept] for k in range(len(self._kept))]
        worths = [worth([one.precision for one in pool], prior) for pool in pools]
        if max(worths) > worth([one.precision for one in self._kept], prior):
            self._kept = pools[int(np.argmax(worths))]

    def _step(self) -> ShapedHand:
        """One step of the shape over all frames that are kept."""
        count, images = len(self._kept), self.config.frames
        # The last one fills up the batch, without weight.
        rows = np.minimum(np.arange(images), count - 1)
        fit = self._fitter.run(
            np.stack([self._kept[k].depth for k in rows]),
            np.stack([self._kept[k].pose for k in rows]),
            self._x, (np.arange(images) < count).astype(float), rounds=1,
            finish=False,
        )  # fmt: skip
        before = self._unknowns.hand(self._x).bone_lengths
        self._steps += 1
        share = min(1.0, self.config.whole_steps / self._steps)
        self._x = self._x + share * (fit.unknowns - self._x)
        for kept, pose, precision in zip(self._kept, fit.poses, fit.precisions, strict=False):
            kept.pose, kept.precision = pose, precision
        certainty = self._certainty = fit.certainty(self._unknowns, range(count))
        hand = self._unknowns.hand(self._x)
        still = np.abs(hand.bone_lengths - before).max() < self.config.settled
        sure = count == images and certainty.lengths.mean() < self.config.sure
        self._calm = self._calm + 1 if still and sure else 0
        self.frozen = self._calm >= self.config.settled_steps
        return hand
