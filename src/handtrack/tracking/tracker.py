"""`HandTracker`: one hand, frame after frame, whatever comes in."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import check_depth
from handtrack.errors import InputError
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, check_side
from handtrack.hand.skeleton import NQ
from handtrack.tracking.discriminative import DiscriminativeConfig
from handtrack.tracking.hybrid import THESIS_HYBRID, HybridConfig
from handtrack.tracking.model_based import THESIS_TRACKER, ModelBasedConfig
from handtrack.tracking.pso import PsoConfig
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.shape_adaption import ShapeAdaption
from handtrack.tracking.stepper import Estimate, Finder, Reshapable, TrackerConfig

FORGET_FRAMES = 10
"""So many frames in a row without the hand, and it is gone: NO_HAND rather than LOST."""

TRACKERS: dict[str, TrackerConfig] = {
    "hybrid": HybridConfig(),
    "thesis_hybrid": THESIS_HYBRID,
    "discriminative": DiscriminativeConfig(),
    "model_based": ModelBasedConfig(),
    "thesis": THESIS_TRACKER,
    "pso": PsoConfig(),
}
"""Name of each tracker and its settings."""

AUTOMATIC: tuple[str, ...] = ("hybrid", "thesis_hybrid", "discriminative")
"""Trackers that find the hand by themselves; the others need a first pose."""


class HandTracker:
    """Tracks one hand in the frames of one depth camera.

    `track` never raises for bad depth; the result's `state` and `problem` say what happened.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        side: str = "right",
        shape: HandShape | None = None,
        device: str | None = None,
        tracker: str = "hybrid",
        config: TrackerConfig | None = None,
        seed: int = 0,
        model: HandModel | None = None,
        graph: bool = True,
        adapt_shape: bool = False,
    ) -> None:
        """Allocate for a camera and a person's hand.

        Args:
            camera: Intrinsics of every frame.
            side: "right" or "left".
            shape: The person's shape; the mean hand when None.
            device: "cpu", "cuda:N" or None for the best there is.
            tracker: One of `TRACKERS`.
            config: Settings instead of the tracker's own.
            seed: Seed of whatever is random: the restarts after a loss.
            model: The parametric hand; the one that comes with handtrack when None.
            graph: False launches eagerly, for debugging.
            adapt_shape: Find the whole shape of the hand while tracking, starting from `shape`, and
                keep it once it is sure; without, only the size of a hand without shape is found.

        Raises:
            InputError: An argument is unusable.
            DeviceError: There is no such device.
        """
        if tracker not in TRACKERS:
            raise InputError(f"tracker is {tracker!r}; expected one of {', '.join(TRACKERS)}")
        self.camera, self.seed = camera, seed
        self.side: Side = check_side(side)
        self._model = model if model is not None else HandModel.load()
        self.hand = self._model.shaped(shape, side=side)
        self._tracker = (config or TRACKERS[tracker]).make(
            self.hand,
            camera,
            known_shape=shape is not None,
            device=device,
            seed=seed,
            graph=graph,
        )
        self._made_hand, self._made_shape = self.hand, shape
        self._adaption: ShapeAdaption | None = None
        if adapt_shape:
            self._changeable()
            self._adaption = ShapeAdaption(
                self._model, camera, side=side, start=shape, device=device, graph=graph
            )
        self._buffer = np.zeros(camera.shape, np.float32)
        self._forget(None)

    @property
    def size(self) -> float:
        """Overall scale of the hand now, against the shape it was made with."""
        return float(self.hand.bone_lengths[0] / self._made_hand.bone_lengths[0])

    @property
    def shape(self) -> HandShape:
        """Shape of the hand now: as it was given, at the size or in the shape found since."""
        if self._adaption is not None and self._adaption.begun:
            return self._adaption.shape
        given = self._made_shape if self._made_shape is not None else HandShape()
        return given if self.size == 1.0 else replace(given, scale=given.scale * self.size)

    @property
    def shape_frozen(self) -> bool:
        """Whether shape adaption is sure of the shape, and has ended."""
        return self._adaption is not None and self._adaption.frozen

    @property
    def automatic(self) -> bool:
        """Whether it finds the hand by itself; the others need `reset(pose)` first."""
        return self._tracker.automatic

    def reset(self, pose: ArrayLike | None = None) -> None:
        """Forget the past; with a pose, shape (28,), go on from there.

        Raises:
            InputError: The pose is not 28 finite numbers with a quaternion.
        """
        good = None if pose is None else _check_pose(pose)
        if self._adaption is not None and self._adaption.begun:
            known = self._made_shape is not None
            self._changeable().reshape(self._made_hand, known_shape=known)
            self._adaption.forget()
        self.hand = self._made_hand
        self._forget(good)
        self._tracker.forget()
        if good is not None:
            self._tracker.start(good)

    def reshape(self, shape: HandShape) -> None:
        """Forget the past and go on with the hand of a known shape, which is not adapted.

        Raises:
            InputError: The tracker is bound to the hand that it was made with.
        """
        tracker = self._changeable()
        self._made_hand, self._made_shape = self._model.shaped(shape, side=self.side), shape
        self._adaption = None
        tracker.reshape(self._made_hand, known_shape=True)
        self.reset()

    def _changeable(self) -> Reshapable:
        """The tracker, if it can change its hand."""
        if not isinstance(self._tracker, Reshapable):
            raise InputError(
                "this tracker is bound to its hand; hybrid and model_based can change it"
            )
        return self._tracker

    def track(self, depth: Any) -> HandResult:
        """Find the hand in the next frame.

        Args:
            depth: Depth image [m], shape (height, width) of the camera, 0 = no measurement.
                Anything else is answered with LOST or NO_HAND and a `problem`.

        Returns:
            The hand's pose, and whether to trust it.
        """
        begin = time.perf_counter()
        clean, problem = check_depth(depth, self.camera, out=self._buffer)
        timings = {"check": 1e3 * (time.perf_counter() - begin)}
        if problem is None and not (self._tracker.started or self._tracker.automatic):
            problem = "the tracker has no first pose; call reset(pose)"
        if problem is not None:
            if self._good is not None:
                # The next good frame goes on from the last good pose, at rest.
                self._tracker.start(self._good)
            return self._missed(np.nan, problem, timings)
        estimate = self._tracker.step(clean, fallback=self._good if self._missed_frames else None)
        timings |= estimate.timings
        self.hand = estimate.hand or self.hand
        timings["total"] = 1e3 * (time.perf_counter() - begin)
        if estimate.found and estimate.pose is not None:
            again = self._missed_frames > 0 and self._good is not None
            self._state = TrackState.RECOVERED if again else TrackState.TRACKING
            self._good, self._missed_frames = estimate.pose, 0
            result = self._result(
                estimate.pose, estimate.depth_error, None, timings, estimate.information
            )
            self._adapt(clean, result)
            return result
        return self._missed(estimate.depth_error, _problem(estimate), timings)

    def _adapt(self, depth: NDArray[np.float32], result: HandResult) -> None:
        """Let the next frame see a hand that is shaped more like the person's."""
        if self._adaption is None:
            return
        begin = time.perf_counter()
        hand = self._adaption.watch(depth, result, self.size)
        if hand is not None:
            self._changeable().reshape(hand, known_shape=True)
            self.hand = hand
        result.timings["shape"] = 1e3 * (time.perf_counter() - begin)
        result.timings["total"] += result.timings["shape"]

    def track_batch(self, depths: Iterable[Any]) -> list[HandResult]:
        """Find the hand in independent frames: no memory is used, and none is kept.

        Args:
            depths: Depth images as for `track`, shape (n, height, width), or a list of them.

        Returns:
            One result per frame: TRACKING, or NO_HAND with a `problem`.

        Raises:
            InputError: The tracker cannot find hands by itself.
        """
        if not isinstance(self._tracker, Finder):
            raise InputError(
                "this tracker needs a first pose; track_batch works with tracker='hybrid'"
            )
        self.reset()
        checked = [check_depth(depth, self.camera) for depth in depths]
        good = [place for place, (_, problem) in enumerate(checked) if problem is None]
        found: dict[int, Estimate] = {}
        if good:
            estimates = self._tracker.find_all(np.stack([checked[place][0] for place in good]))
            found = dict(zip(good, estimates, strict=True))
        return [
            self._alone(found.get(place), problem) for place, (_, problem) in enumerate(checked)
        ]

    def _alone(self, estimate: Estimate | None, problem: str | None) -> HandResult:
        """The result of a frame that stands alone."""
        if estimate is None or not estimate.found or estimate.pose is None:
            return HandResult(
                state=TrackState.NO_HAND, side=self.side, pose=np.full(NQ, np.nan),
                depth_error=np.nan, hand=self.hand, problem=problem or _problem(estimate),
            )  # fmt: skip
        return HandResult(
            state=TrackState.TRACKING, side=self.side, pose=estimate.pose.copy(),
            depth_error=estimate.depth_error, hand=estimate.hand or self.hand,
            information=estimate.information,
        )  # fmt: skip

    def _forget(self, good: NDArray[np.float64] | None) -> None:
        """Start anew, from a pose or from nothing."""
        self._state = TrackState.NO_HAND
        self._good = good
        self._missed_frames = 0

    def _missed(self, error: float, problem: str, timings: dict[str, float]) -> HandResult:
        """The result of a frame without the hand: the last good pose, until it is forgotten."""
        self._missed_frames += 1
        gone = self._tracker.automatic and self._missed_frames > FORGET_FRAMES
        if self._good is None or gone:
            self._state = TrackState.NO_HAND
            return self._result(np.full(NQ, np.nan), np.nan, problem, timings)
        self._state = TrackState.LOST
        return self._result(self._good, error, problem, timings)

    def _result(
        self, pose: NDArray[np.float64], error: float, problem: str | None,
        timings: dict[str, float], information: FitInformation | None = None,
    ) -> HandResult:  # fmt: skip
        return HandResult(
            state=self._state, side=self.side, pose=pose.copy(), depth_error=float(error),
            hand=self.hand, problem=problem, timings=timings, information=information,
        )  # fmt: skip


def _problem(estimate: Estimate | None) -> str:
    """Why an estimate is no result."""
    told = estimate.problem if estimate is not None else None
    return told or "the hand explains the image too badly"


def _check_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """A pose of 28 finite numbers with a unit quaternion."""
    try:
        value = np.array(pose, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"pose is not numeric: {error}") from None
    if value.shape != (NQ,) or not np.isfinite(value).all():
        raise InputError(f"pose has shape {value.shape}; expected 28 finite numbers")
    length = np.linalg.norm(value[3:7])
    if not 0.5 < length < 2.0:
        raise InputError(f"pose[3:7] has length {length:g}; expected a unit quaternion w x y z")
    value[3:7] /= length
    return value
