"""The overall size of a hand whose owner is not known, found while tracking.

The same pose is fitted with a smaller, the same and a larger hand; where the depth error falls, the
size follows. Bone proportions and flesh stay as they are. Estimating size while tracking is after
Makris and Argyros, "Model-based 3D hand tracking with on-line shape adaptation", BMVC 2015.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand

SMALLEST, LARGEST = 0.75, 1.3
"""Sizes that are allowed, against the hand that was given; children to very large men."""

WIDE, NARROW = 0.06, 0.03
"""Steps up and down that are compared: at first sight, and while tracking."""

LOOKS = 4
"""Frames whose errors are averaged before the size follows."""

PERIOD, CALM_PERIOD = 2, 15
"""Frames from one look to the next: until the size has settled, and then."""

SETTLED = 0.006
"""A change below this says that the size has settled."""

USUAL_SPREAD, UNUSUAL_COST = 0.06, 0.002
"""Deviation of hand sizes among people, and the scale of what unusual ones cost beside the depth
error [m]; a thin hand looks like a small one, and this keeps the size from making up for flesh."""

Float = NDArray[np.float64]


class SizeProbe:
    """Compares three sizes of one hand."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        fit: FitConfig,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            hand: The hand at size 1.
            camera: Camera of the depth images.
            fit: The fit; four iterations of it are taken.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self._hand = hand
        self._fitter = Fitter(
            [hand] * 3, camera, config=replace(fit, iterations=4), device=device, graph=graph
        )
        self._fitter.warm_up()
        self.forget()

    def reshape(self, hand: ShapedHand) -> None:
        """Start anew with another hand at size 1."""
        self._hand = hand
        self.forget()

    def forget(self) -> None:
        """Start anew at size 1."""
        self.size = 1.0
        self._period = PERIOD
        self._begin_looks()

    def _begin_looks(self) -> None:
        self._errors, self._count, self._since = np.zeros(3), 0, 0

    def settle(self, depth: NDArray[np.float32], pose: Float) -> bool:
        """Take a size from one frame, coarsely; for the first sight of a hand.

        Returns:
            Whether the size has changed.
        """
        before = self.size
        for step in (WIDE, WIDE, WIDE, WIDE, NARROW):
            self._follow(self._compare(depth, pose, step), step)
        self._begin_looks()
        return self.size != before

    def watch(self, depth: NDArray[np.float32], pose: Float) -> bool:
        """Take a frame that is tracked well into account; most calls only count.

        Returns:
            Whether the size has changed.
        """
        self._since += 1
        if self._since < self._period:
            return False
        self._since = 0
        self._errors += self._compare(depth, pose, NARROW)
        self._count += 1
        if self._count < LOOKS:
            return False
        before = self.size
        self._follow(self._errors, NARROW)
        self._begin_looks()
        self._period = CALM_PERIOD if abs(self.size / before - 1.0) < SETTLED else PERIOD
        return self.size != before

    def _compare(self, depth: NDArray[np.float32], pose: Float, step: float) -> Float:
        """Costs of a smaller, the same and a larger hand [m], shape (3,)."""
        sizes = self.size * np.array([1.0 - step, 1.0, 1.0 + step])
        hands = [self._hand.scaled(size) for size in sizes]
        self._fitter.hand.resize(hands)  # spheres hardly matter in four iterations
        self._fitter.load_depth(np.broadcast_to(depth, (3, *depth.shape)))
        self._fitter.place(np.tile(keypoints(hands[1], pose).mean(axis=0), (3, 1)))
        self._fitter.set_poses(np.tile(pose, (3, 1)))
        self._fitter.run()
        # Heavy-tailed: children and very large hands are rare, not impossible.
        unusual = np.log1p(0.5 * ((sizes - 1.0) / USUAL_SPREAD) ** 2)
        return self._fitter.errors.astype(np.float64) + UNUSUAL_COST * unusual

    def _follow(self, errors: Float, step: float) -> None:
        """Go to the lowest point of the parabola through three errors, one step at most."""
        slope, bend = errors[2] - errors[0], errors[0] - 2 * errors[1] + errors[2]
        if bend > 0:
            move = float(np.clip(-0.5 * slope / bend, -1.0, 1.0))
        else:
            move = -float(np.sign(slope))
        self.size = float(np.clip(self.size * (1.0 + step * move), SMALLEST, LARGEST))
