"""Fit one person's shape to several depth images: poses and shape in turn (Eq. II.11).

All images are rows of one batch. Poses follow from the fit of Eq. II.21 with the shape held. The
shape then takes a Gauss-Newton step over all images at once in which, unlike in the thesis, the
poses answer: a finger that is too short is bent too little, and with the poses held it would hold
on to its length for dozens of rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.fitting.fitter import SQUARE_METRE, Fitter
from handtrack.fitting.shape_certainty import ShapeCertainty, image_precisions, shape_certainty
from handtrack.fitting.shape_config import ShapeFitConfig
from handtrack.fitting.shape_system import ShapeEquations, ShapeSystem
from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import NV
from handtrack.transforms import apply_increment

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFit:
    """What a fit of a shape found."""

    unknowns: Float
    """log(scale), alpha, beta; shape (nshape,)."""
    poses: Float
    """Pose in each image, shape (n, 28)."""
    errors: Float
    """Depth error E_d of each image [m], shape (n,)."""
    rounds: int
    """Rounds taken."""
    converged: bool
    """Whether the bone lengths had settled by then."""
    information: Float
    """What each image tells of the shape when its pose follows, in the fit's weights; shape (n,
    nshape, nshape)."""
    pose_information: list[FitInformation]
    """What the fit of each image's pose knew."""
    scale_deviation: float
    """Deviation of log(scale) that the prior assumed."""

    @property
    def precisions(self) -> Float:
        """What each image tells of the shape, inverse covariances, shape (n, nshape, nshape)."""
        return image_precisions(self.information, self.pose_information)

    def certainty(
        self, unknowns: ShapeUnknowns, images: Sequence[int] | None = None
    ) -> ShapeCertainty:
        """How sure the shape is.

        Args:
            unknowns: The unknowns.
            images: The images that count; all without.
        """
        used = list(range(len(self.poses)) if images is None else images)
        return shape_certainty(
            unknowns, self.unknowns, self.information[used], self.poses[used],
            [self.pose_information[k] for k in used], scale_deviation=self.scale_deviation,
        )  # fmt: skip


class ShapeFitter:
    """Everything allocated for fitting one shape to a fixed number of images."""

    def __init__(
        self,
        model: HandModel,
        camera: Camera,
        *,
        images: int,
        side: str = "right",
        config: ShapeFitConfig | None = None,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            model: The parametric hand.
            camera: Camera of the depth images.
            images: Images fitted at a time.
            side: "right" or "left".
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self.config = config if config is not None else ShapeFitConfig()
        self.unknowns = ShapeUnknowns(model, side=side)
        self.images, self._camera = images, camera
        hand = self.unknowns.hand(np.zeros(self.unknowns.count))
        self._fitter = Fitter(
            [hand] * images, camera, config=self.config.fit, device=device, graph=graph
        )
        self._system = ShapeSystem(self._fitter, self.unknowns, graph=graph)
        self._floor = np.full(NV, self.config.pose_floor)
        self._floor[:3] *= SQUARE_METRE
        deviations = np.ones(self.unknowns.count)
        deviations[0] = self.config.scale_deviation
        self._prior = self.config.prior_weight / deviations**2
        self._longest = self.config.max_step * deviations

    @property
    def prior_precision(self) -> Float:
        """Inverse covariance of the unknowns without any image, shape (nshape, nshape)."""
        return np.diag(self._prior / self.config.prior_weight)

    def run(
        self, depths: ArrayLike, poses: ArrayLike, start: Float | None = None,
        weights: ArrayLike | None = None, rounds: int | None = None,
        finish: bool = True,
    ) -> ShapeFit:  # fmt: skip
        """Fit.

        Args:
            depths: Clean depth images [m], shape (images, height, width).
            poses: Pose to start from in each, shape (images, 28).
            start: Unknowns to start from, shape (nshape,); the mean hand's without.
            weights: How much each image counts, 0 leaves one out; shape (images,).
            rounds: Most rounds; the configuration's without.
            finish: Fit the poses once more to the last shape. Without, poses, errors and
                information are those of the shape before its last step, in half the time.

        Raises:
            InputError: There are not as many poses and images as this was made for.
        """
        poses = np.array(poses, np.float64)
        if poses.shape != (self.images, 28):
            raise InputError(f"poses have shape {poses.shape}; expected ({self.images}, 28)")
        config = self.config
        counts = np.ones(self.images) if weights is None else np.asarray(weights, np.float64)
        x = np.zeros(self.unknowns.count) if start is None else np.array(start, np.float64)
        self._fitter.load_depth(depths)
        converged, rounds_taken = False, 0
        equations: ShapeEquations | None = None
        lengths = self._wear(x)
        share, last = 1.0, np.zeros_like(x)
        for _ in range(config.rounds if rounds is None else rounds):
            rounds_taken += 1
            poses = self._fit_poses(poses)
            equations = self._system.build(x)
            step, turns = self._step(equations, counts, x, share)
            # Points that change their partners to and fro must not keep the shape swinging.
            share = 0.5 * share if step @ (last / self._longest**2) < 0 else min(1.0, 1.3 * share)
            last = step
            x = x + step
            poses = apply_increment(poses, turns)
            before, lengths = lengths, self._wear(x)
            converged = bool(np.abs(lengths - before).max() < config.settled)
            if converged:
                break
        if finish or equations is None:
            poses = self._fit_poses(poses)
            equations = self._system.build(x)
        return ShapeFit(
            unknowns=x, poses=poses, errors=self._fitter.errors.astype(np.float64),
            rounds=rounds_taken, converged=converged, information=equations.reduced(self._floor)[0],
            pose_information=[self._fitter.information(row) for row in range(self.images)],
            scale_deviation=config.scale_deviation,
        )  # fmt: skip

    def warm_up(self) -> None:
        """Compile the kernels and capture the graphs, on empty images."""
        pose = np.zeros(28)
        pose[2], pose[3] = 0.5, 1.0
        self.run(
            np.zeros((self.images, *self._camera.shape), np.float32),
            np.tile(pose, (self.images, 1)), rounds=0,
        )  # fmt: skip

    def _wear(self, x: Float) -> Float:
        """Go on with the hand of unknowns; its bone lengths [m], shape (16,)."""
        hand = self.unknowns.hand(x)
        self._hand = hand
        self._fitter.resize([hand] * self.images)
        return hand.bone_lengths

    def _fit_poses(self, starts: Float) -> Float:
        """Poses with the shape held, shape (images, 28)."""
        self._fitter.place(keypoints(self._hand, starts).mean(axis=1))
        self._fitter.set_poses(starts)
        self._fitter.run()
        poses = self._fitter.poses.astype(np.float64)
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        return poses

    def _step(
        self, equations: ShapeEquations, counts: Float, x: Float, share: float
    ) -> tuple[Float, Float]:
        """Share of a step of the shape, shape (nshape,), and the poses' answer, (images, 27)."""
        if self.config.follow_poses:
            matrices, gradients = equations.reduced(self._floor)
        else:
            matrices, gradients = equations.shapes, equations.shape_gradients
        matrix = np.einsum("r,rij->ij", counts, matrices) + np.diag(self._prior)
        gradient = counts @ gradients + self._prior * x
        step = -share * np.linalg.solve(matrix, gradient)
        step /= max(1.0, float(np.abs(step / self._longest).max()))
        if not self.config.follow_poses:
            return step, np.zeros((self.images, NV))
        return step, equations.pose_steps(self._floor, step)
