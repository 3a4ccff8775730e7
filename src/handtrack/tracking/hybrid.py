"""Hybrid tracking: the forest's candidates compete with the tracked pose (thesis II.5.1).

The thesis searches every frame. Here the last pose and its extrapolation are followed first, and
candidates are called in where the depth error raises doubt; when the hand is lost they are looked
for in several regions of the whole scene.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.segmentation import find_hand_regions
from handtrack.errors import InputError
from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.fitting.uncertainty import FitInformation
from handtrack.forest.artifact import Forest
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NV
from handtrack.tracking.candidates import Candidates, CandidateSearch
from handtrack.tracking.doubt import Doubt
from handtrack.tracking.rescue import restart_poses
from handtrack.tracking.stepper import Estimate
from handtrack.transforms import apply_increment, pose_difference

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class HybridConfig:
    """Settings of the hybrid tracker."""

    fit: FitConfig = field(default_factory=FitConfig)
    """The fit of the tracked pose, and of the best candidates in the end."""
    search: FitConfig = field(default_factory=lambda: replace(FitConfig(), iterations=4))
    """The refinement of all candidates (step 4)."""
    forest: str | None = None
    """File of the forest; the one that comes with handtrack when None."""
    always: bool = False
    """Search every frame, as the thesis does."""
    velocity: float = 1.0
    """Share of the last motion that a second hypothesis repeats."""
    restarts: int = 4
    """Random restarts around the tracked pose that join the pool in doubt."""
    finalists: int = 4
    """Candidates that are fitted to the end."""
    regions: int = 3
    """Places of the scene that are searched when the hand is lost."""
    doubt_error: float = 0.007
    """Depth error up to which the tracked pose is not doubted [m]."""
    doubt_jump: float = 1.25
    """Errors above so much of their running level are doubted at once."""
    doubt_period: int = 10
    """Frames between doubts when the error is high but steady."""
    gain: float = 0.92
    """A candidate replaces the tracked pose when its cost is below so much of the tracked one's."""
    temporal_weight: float = 2e-4
    """lambda_2 of Eq. II.20: cost [m] of a squared change of pose by one radian or decimetre."""
    seek_error: float = 0.012
    """Depth error above which the whole scene is searched too [m]."""
    accept_error: float = 0.012
    """Depth error below which a hand counts as found where there was none [m]."""
    lost_error: float = 0.016
    """tau of Eq. II.19: depth error above which the hand counts as lost [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not 0 <= self.velocity <= 2:
            raise InputError(f"velocity is {self.velocity}; expected 0 to 2")
        if self.restarts < 0 or self.finalists < 1 or self.regions < 1:
            raise InputError(
                f"restarts, finalists, regions are {self.restarts}, {self.finalists},"
                f" {self.regions}; expected at least 0, 1 and 1"
            )
        if self.doubt_jump < 1 or self.doubt_period < 1 or self.doubt_error < 0:
            raise InputError(
                f"doubt_jump, doubt_period, doubt_error are {self.doubt_jump},"
                f" {self.doubt_period}, {self.doubt_error}; expected at least 1, 1 and 0"
            )
        if not 0 < self.gain <= 1 or self.temporal_weight < 0:
            raise InputError(
                f"gain and temporal_weight are {self.gain} and {self.temporal_weight}; expected 0"
                " to 1 and at least 0"
            )
        for name in ("seek_error", "accept_error", "lost_error"):
            if not 0 < getattr(self, name) <= self.fit.score_cap:
                raise InputError(
                    f"{name} is {getattr(self, name)}; expected up to score_cap"
                    f" {self.fit.score_cap}"
                )

    def make(
        self, hand: ShapedHand, camera: Camera, *, device: str | None, seed: int, graph: bool
    ) -> TrackerHybrid:
        """Allocate the method; see `Stepper`."""
        return TrackerHybrid(hand, camera, config=self, device=device, seed=seed, graph=graph)


THESIS_HYBRID = HybridConfig(
    fit=THESIS, search=THESIS, always=True, velocity=0.0, restarts=0, regions=1, finalists=1,
    temporal_weight=2e-4,
)  # fmt: skip
"""Steps 1 to 6 of II.5.1 with the thesis' own energy, and nothing else."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """A pose with what decides about it."""

    pose: Float
    error: float
    information: FitInformation | None


class TrackerHybrid:
    """Finds one hand by itself and follows it."""

    automatic = True

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        config: HybridConfig | None = None,
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
        self.config = config if config is not None else HybridConfig()
        self._hand, self._camera = hand, camera
        config = self.config
        forest = Forest.load(config.forest)
        right = hand.as_right()
        self._followed = 1 + (config.velocity > 0)

        def fitter(rows: int) -> Fitter:
            return Fitter([hand], camera, config=config.fit, nhyp=rows, device=device, graph=graph)

        def search(places: int, extra: int) -> CandidateSearch:
            return CandidateSearch(
                hand, right, camera, forest, fit=config.search, places=places, extra=extra,
                device=device, graph=graph,
            )  # fmt: skip

        self._fitter = fitter(self._followed)
        self._final = fitter(config.finalists)
        self._near = search(1, 1 + config.restarts)
        self._far = search(config.regions, 0)
        for used in (self._fitter, self._final, self._near, self._far):
            used.warm_up()
        self._seed = seed
        self._doubt = Doubt(
            error=config.doubt_error, jump=config.doubt_jump, period=config.doubt_period
        )
        self.start(None)

    @property
    def started(self) -> bool:
        """Whether there is a pose to go on from."""
        return self._pose is not None

    def start(self, pose: Float | None) -> None:
        """Go on from a pose at rest, shape (28,), or from nothing."""
        self._pose: Float | None = None if pose is None else np.array(pose, np.float64)
        self._sure = pose is not None
        self._motion = np.zeros(NV)
        self._rng = np.random.default_rng(self._seed)
        self._doubt.forget()

    def step(self, depth: NDArray[np.float32], *, fallback: Float | None = None) -> Estimate:
        """Find the hand in the next frame; see `Stepper`."""
        config, clock = self.config, _Clock()
        if config.always:
            found = self._search_as_thesis(depth)
            clock.lap("search")
        else:
            found = self._follow(depth, fallback)
            clock.lap("follow")
            if found is not None and (
                self._doubt.arises(found.error) or found.error > config.seek_error
            ):
                found = self._search_near(depth, found)
                clock.lap("near")
            if found is None or found.error > config.seek_error:
                found = self._search_far(depth, found)
                clock.lap("far")
        if found is None:
            self._pose, self._sure = None, False
            return Estimate(
                pose=None, depth_error=np.nan, found=False, timings=clock.spans,
                problem="nothing in view has the size of a hand",
            )  # fmt: skip
        limit = config.lost_error if self._sure else config.accept_error
        self._motion = np.zeros(NV)
        if self._sure and self._pose is not None:
            self._motion = pose_difference(found.pose, self._pose)
        self._sure = found.error < limit
        self._doubt.remember(found.error)
        self._pose = found.pose
        return Estimate(
            pose=found.pose, depth_error=found.error, found=self._sure,
            information=found.information, timings=clock.spans,
        )  # fmt: skip

    def _follow(self, depth: NDArray[np.float32], fallback: Float | None) -> _Found | None:
        """The last pose and its extrapolation, or the last good pose, fitted."""
        if self._pose is None:
            return None
        other = fallback
        if other is None:
            other = apply_increment(self._pose, self.config.velocity * self._motion)
        return self._fit(self._fitter, depth, np.stack([self._pose, other][: self._followed]))

    def _search_near(self, depth: NDArray[np.float32], tracked: _Found) -> _Found:
        """The tracked pose, or a better candidate from about the same place."""
        config = self.config
        pool = np.concatenate([
            tracked.pose[None],
            restart_poses(self._hand, tracked.pose, config.restarts, self._rng),
        ])  # fmt: skip
        centre = keypoints(self._hand, tracked.pose).mean(axis=0)
        candidates = self._near.run(depth, centre[None], extra=pool)
        return self._best(depth, candidates, tracked)

    def _search_far(self, depth: NDArray[np.float32], tracked: _Found | None) -> _Found | None:
        """The best candidate of the whole scene, or the tracked pose when that is better."""
        regions = find_hand_regions(depth, self._camera, max_regions=self._far.places)
        if not regions:
            return tracked
        centres = np.stack([region.centre for region in regions])
        # Every place is searched by as many rows; the best region takes those left over.
        missing = self._far.places - len(centres)
        centres = np.concatenate([centres, np.tile(centres[:1], (missing, 1))])
        return self._best(depth, self._far.run(depth, centres), tracked)

    def _best(
        self, depth: NDArray[np.float32], candidates: Candidates, tracked: _Found | None
    ) -> _Found:
        """The lowest cost E_c among the tracked pose and the finalists (Eq. II.20)."""
        finalists = self._distinct(candidates)
        best = self._fit(self._final, depth, finalists)
        if tracked is None:
            return best
        improved = self._cost(best.pose, best.error) < self.config.gain * self._cost(
            tracked.pose, tracked.error
        )
        return best if improved else tracked

    def _distinct(self, candidates: Candidates) -> Float:
        """The best candidates that differ from each other, as many as are fitted to the end."""
        points = keypoints(self._hand, candidates.poses)
        chosen = [0]
        for row in range(1, len(points)):
            if len(chosen) == self.config.finalists:
                break
            if candidates.places[row] != candidates.places[chosen[0]]:
                continue
            gaps = np.linalg.norm(points[chosen] - points[row], axis=-1).mean(axis=-1)
            if gaps.min() > 0.004:
                chosen.append(row)
        chosen += [chosen[-1]] * (self.config.finalists - len(chosen))
        return candidates.poses[chosen]

    def _search_as_thesis(self, depth: NDArray[np.float32]) -> _Found | None:
        """Steps 1 to 5: every frame is searched, the last pose is one candidate of the pool."""
        last = self._pose if self._sure else None
        if last is not None:
            centre = keypoints(self._hand, last).mean(axis=0)
            candidates = self._near.run(depth, centre[None], extra=last[None], reference=last)
        else:
            regions = find_hand_regions(depth, self._camera, max_regions=1)
            if not regions:
                return None
            candidates = self._far.run(depth, regions[0].centre[None])
        costs = np.array([
            self._cost(pose, error)
            for pose, error in zip(candidates.poses, candidates.errors, strict=True)
        ])  # fmt: skip
        best = int(np.argmin(costs))
        return _Found(
            pose=candidates.poses[best], error=float(candidates.errors[best]), information=None
        )

    def _cost(self, pose: Float, error: float) -> float:
        """E_c of Eq. II.20 [m]; the temporal term counts only after a frame that was tracked."""
        if not self._sure or self._pose is None:
            return error
        change = pose_difference(pose, self._pose)
        change[:3] *= 10.0  # in decimetres
        return error + self.config.temporal_weight * float(change @ change)

    def _fit(self, fitter: Fitter, depth: NDArray[np.float32], starts: Float) -> _Found:
        """The lowest cost of some starts fitted to the end."""
        centre = keypoints(self._hand, starts).mean(axis=(0, 1))
        fitter.load_depth(depth)
        fitter.place(centre)
        fitter.set_poses(starts)
        fitter.run()
        errors = fitter.errors.astype(np.float64)
        best = int(np.argmin(errors))
        pose = fitter.poses[best].astype(np.float64)
        pose[3:7] /= np.linalg.norm(pose[3:7])
        return _Found(pose=pose, error=float(errors[best]), information=fitter.information(best))


class _Clock:
    """Time spent per stage [ms]."""

    def __init__(self) -> None:
        self.spans: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """The time since the last lap goes to a stage."""
        now = time.perf_counter()
        self.spans[name] = self.spans.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
