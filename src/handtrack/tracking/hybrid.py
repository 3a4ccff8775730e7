"""Hybrid tracking: the forest's candidates compete with the tracked pose (thesis II.5.1).

The thesis searches every frame. Here the last pose and its extrapolation are followed first, and
candidates are called in where the depth error raises doubt; when the hand is lost they are looked
for in several regions of the whole scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.segmentation import HandRegion, centres_of
from handtrack.errors import InputError
from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.fitting.uncertainty import FitInformation
from handtrack.forest.artifact import Forest
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NV
from handtrack.tracking.best_fit import fit_best
from handtrack.tracking.candidates import Candidates, CandidateSearch, misplacement
from handtrack.tracking.doubt import Doubt
from handtrack.tracking.judge import HandJudge
from handtrack.tracking.patience import Patience
from handtrack.tracking.rescue import restart_poses
from handtrack.tracking.scene_search import Found, SceneSearch, SearchConfig, search_until
from handtrack.tracking.size_probe import SizeProbe
from handtrack.tracking.stage_clock import StageClock
from handtrack.tracking.stepper import Estimate
from handtrack.tracking.trust import Trust, TrustConfig
from handtrack.transforms import apply_increment, pose_difference

Float = NDArray[np.float64]

BATCH = 8
"""Independent frames searched at a time by `find_all`."""


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
    scene: SearchConfig = field(default_factory=SearchConfig)
    """The search of whole scenes when the hand is lost."""
    presence_weight: float = 0.08
    """Cost of a candidate in a place that the forest takes for no hand [m]."""
    adapt_size: bool = True
    """Find the overall size of a hand whose shape was not given."""
    doubt_error: float = 0.007
    """Depth error up to which the tracked pose is not doubted [m]."""
    doubt_jump: float = 1.25
    """Errors above so much of their running level are doubted at once."""
    doubt_period: int = 10
    """Frames between doubts when the error is high but steady."""
    young_frames: int = 15
    """Frames for which a new track is doubted whenever its error is high."""
    gain: float = 0.92
    """A candidate replaces the tracked pose when its cost is below so much of the tracked one's."""
    temporal_weight: float = 2e-4
    """lambda_2 of Eq. II.20: cost [m] of a squared change of pose by one radian or decimetre."""
    seek_error: float = 0.012
    """Depth error above which the whole scene is searched too [m]."""
    judged: bool = True
    """Ask, beyond the depth error, whether what is tracked is a hand; see `Trust`."""
    attempts: int = 3
    """Searches of a new scene, at most, while the judge is not convinced."""
    trust: TrustConfig = field(default_factory=TrustConfig)
    """When it is taken for one."""
    lost_error: float = 0.016
    """tau of Eq. II.19: depth error above which the hand counts as lost [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not 0 <= self.velocity <= 2:
            raise InputError(f"velocity is {self.velocity}; expected 0 to 2")
        for name, least in (
            ("restarts", 0),
            ("finalists", 1),
            ("presence_weight", 0),
            ("attempts", 1),
        ):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least {least}")
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
        for name in ("seek_error", "lost_error"):
            if not 0 < getattr(self, name) <= self.fit.score_cap:
                raise InputError(
                    f"{name} is {getattr(self, name)}; expected up to score_cap"
                    f" {self.fit.score_cap}"
                )

    def make(
        self, hand: ShapedHand, camera: Camera, *, known_shape: bool, device: str | None,
        seed: int, graph: bool,
    ) -> TrackerHybrid:  # fmt: skip
        """Allocate the method; see `TrackerConfig`."""
        config = replace(self, adapt_size=self.adapt_size and not known_shape)
        return TrackerHybrid(hand, camera, config=config, device=device, seed=seed, graph=graph)


THESIS_HYBRID = HybridConfig(
    fit=THESIS, search=THESIS, always=True, velocity=0.0, restarts=0, finalists=1,
    presence_weight=0.0, adapt_size=False, judged=False, scene=SearchConfig(regions=1, rounds=0),
)  # fmt: skip
"""Steps 1 to 6 of II.5.1 with the thesis' own energy, and nothing else."""


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
        self._base, self._hand, self._camera = hand, hand, camera
        config = self.config
        self._forest = Forest.load(config.forest)
        self._options: dict[str, Any] = {"device": device, "graph": graph}
        self._follower = Fitter(
            [hand], camera, config=config.fit, nhyp=1 + (config.velocity > 0), **self._options
        )
        self._follower.warm_up()
        self._near = CandidateSearch(
            hand, camera, self._forest, fit=config.search, places=1, extra=1 + config.restarts,
            **self._options,
        )  # fmt: skip
        self._near.warm_up()
        self._scene = self._scene_search(1)
        self._batch: SceneSearch | None = None
        self._probe: SizeProbe | None = None
        if config.adapt_size:
            self._probe = SizeProbe(hand, camera, fit=config.fit, **self._options)
        self._sizing = self._probe is not None
        self._settled = False
        self._judge = HandJudge(hand, camera, device=device) if config.judged else None
        self._trust = Trust(config.trust)
        self._patience = Patience()
        self._seed = seed
        self._doubt = Doubt(
            error=config.doubt_error,
            jump=config.doubt_jump,
            period=config.doubt_period,
            young=config.young_frames,
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
        self._trust.forget(known=pose is not None)
        self._patience.forget()

    def forget(self) -> None:
        """Start from nothing, with a hand of unknown size; see `Stepper`."""
        self.start(None)
        self._settled = False
        if self._probe is not None and self._probe.size != 1.0:
            self._probe.forget()
            self._resize()

    def reshape(self, hand: ShapedHand, *, known_shape: bool) -> None:
        """Go on with another hand; see `Reshapable`."""
        self._base = hand
        if self._probe is not None:
            self._probe.reshape(hand)
            self._sizing = not known_shape
        self._resize()

    def _resize(self) -> None:
        """Go on with the hand as it was given, at the size that the probe has found."""
        size = 1.0 if self._probe is None else self._probe.size
        self._hand = self._base.scaled(size)
        self._follower.resize([self._hand])
        for part in (self._near, self._scene, self._batch, self._judge):
            if part is not None:
                part.resize(self._hand)
        # Depth errors of another hand do not compare.
        self._doubt.forget_level()

    def step(self, depth: NDArray[np.float32], *, fallback: Float | None = None) -> Estimate:
        """Find the hand in the next frame; see `Stepper`."""
        config, clock = self.config, StageClock()
        regions = cache(lambda: self._scene.regions(depth[None]))
        if self._patience.refused and not self._sure:
            waits = self._patience.waits(centres_of(regions()[0]))
            clock.lap("scene")
            if waits:
                return self._estimate(None, False, clock.spans)
        if config.always:
            found, doubted = self._search_as_thesis(depth, regions), True
            clock.lap("search")
        else:
            found = self._follow(depth, fallback)
            clock.lap("follow")
            doubted = (
                found is None
                or self._doubt.arises(found.error, suspected=self._trust.doubtful)
                or not self._sure
            )
            if doubted and found is not None:
                found = self._search_near(depth, found)
                clock.lap("near")
            if doubted and (
                found is None
                or found.error > config.seek_error
                or (self._trust.doubtful and (not self._sure or self._doubt.young))
            ):
                found = self._search_scene(depth, found, regions())
                clock.lap("scene")
        first_sight = not self._sure
        if found is not None:
            settle = first_sight or not self._settled
            found, resized = self._sized(depth, found, settle=settle, watch=not doubted)
            clock.lap("size")
            if self._judge is not None and (doubted or resized or self._trust.due):
                self._trust.hear(self._odds(depth, found))
                clock.lap("judge")
            self._settled |= not self._trust.doubtful
        estimate = self._estimate(found, self._believed, clock.spans)
        self._motion = np.zeros(NV)
        if found is not None:
            if self._sure and self._pose is not None:
                self._motion = pose_difference(found.pose, self._pose)
            self._doubt.remember(found.error)
            if first_sight:
                self._doubt.forget()
        lost = self._sure and not estimate.found
        self._pose, self._sure = estimate.pose, estimate.found
        if lost:
            self._trust.forget(known=False)
        elif not self._sure and self._trust.refuses:
            # Nothing to go on from: the next search starts from scratch.
            self._patience.refuse(centres_of(regions()[0]))
            self._trust.forget(known=False)
            self._pose = None
        else:
            self._patience.forget()
        return estimate

    @property
    def _believed(self) -> bool:
        """Whether the track counts as a hand."""
        return self._judge is None or self._trust.believes(sure=self._sure)

    def _odds(self, depth: NDArray[np.float32], found: Found) -> float:
        """The judge's log-odds of a pose; beyond all doubt without a judge."""
        if self._judge is None:
            return np.inf
        return self._judge.log_odds(depth, found.pose, found.error, found.presence)

    def _odds_resized(self, depth: NDArray[np.float32], found: Found) -> float:
        """The same, of a pose that may have to be looked at in another size first."""
        odds = self._odds(depth, found)
        if self._probe is None or self._trust.convinced(odds):
            return odds
        size = self._probe.size
        resized, changed = self._sized(depth, found, settle=True, watch=False)
        if changed:
            odds = max(odds, self._odds(depth, resized))
            self._probe.size = size
            self._resize()
        return odds

    def _sized(
        self, depth: NDArray[np.float32], found: Found, *, settle: bool, watch: bool
    ) -> tuple[Found, bool]:
        """The pose of a hand of better size, and whether the size has changed."""
        if self._probe is None or not self._sizing:
            return found, False
        if settle:
            changed = self._probe.settle(depth, found.pose)
        else:
            changed = watch and self._probe.watch(depth, found.pose)
        if not changed:
            return found, False
        self._resize()
        again = self._fit(depth, np.stack([found.pose] * self._follower.nrow))
        return replace(again, presence=found.presence), True

    def _estimate(self, found: Found | None, believed: bool, timings: dict[str, float]) -> Estimate:
        """What to report of a pose: it must explain its frame (Eq. II.19), and be a hand's."""
        if found is None:
            return Estimate(
                pose=None, depth_error=np.nan, found=False, timings=timings,
                problem="nothing in view has the size of a hand",
            )  # fmt: skip
        explained = found.error < self.config.lost_error
        return Estimate(
            pose=found.pose, depth_error=found.error, found=explained and believed,
            information=self._informed(found.information), hand=self._hand, timings=timings,
            problem="what is in view hardly looks like a hand" if explained else None,
        )  # fmt: skip

    def _informed(self, information: FitInformation | None) -> FitInformation | None:
        """What the fit knew, and whether it knew the person's hand."""
        if information is None:
            return None
        return replace(information, shape_known=not self._sizing)

    def _follow(self, depth: NDArray[np.float32], fallback: Float | None) -> Found | None:
        """The last pose and its extrapolation, or the last good pose, fitted."""
        if self._pose is None:
            return None
        other = fallback
        if other is None:
            other = apply_increment(self._pose, self.config.velocity * self._motion)
        return self._fit(depth, np.stack([self._pose, other][: self._follower.nrow]))

    def _search_near(self, depth: NDArray[np.float32], tracked: Found) -> Found:
        """The tracked pose, or a better candidate from about the same place."""
        pool = np.concatenate([
            tracked.pose[None],
            restart_poses(self._hand, tracked.pose, self.config.restarts, self._rng),
        ])  # fmt: skip
        centre = keypoints(self._hand, tracked.pose).mean(axis=0)
        candidates = self._near.run(depth, centre[None], extra=pool)
        (found,) = self._scene.finish(depth[None], [candidates], self._costs)
        # What the forest says of a place means something for places that segmentation proposed.
        return self._better(depth, tracked, replace(found, presence=None))

    def _search_scene(
        self, depth: NDArray[np.float32], tracked: Found | None, regions: list[list[HandRegion]]
    ) -> Found | None:
        """The best candidate of the whole scene, or the tracked pose when that is better."""
        if self._sure or self._judge is None:
            # A hand that was there a moment ago has hardly turned over.
            turned = 0.0 if self._sure else None
            (found,) = self._scene.run(depth[None], regions, self._costs, self._rng, turned=turned)
            if found is None or tracked is None:
                return found or tracked
            chosen = self._better(depth, tracked, found)
        else:
            fresh = tracked is None and not self._patience.refused
            ((found, odds),) = search_until(
                self._scene, depth[None], regions, self._hand, self._costs, self._rng,
                odds=self._odds_resized, convinced=self._trust.convinced,
                attempts=self.config.attempts if fresh else 1,
            )  # fmt: skip
            if found is None or tracked is None:
                return found or tracked
            chosen = found if odds >= self._trust.odds else tracked
        if chosen is found:
            # What was believed of the other place says nothing of this one.
            self._trust.forget(known=False)
        return chosen

    def _better(self, depth: NDArray[np.float32], tracked: Found, found: Found) -> Found:
        """The tracked pose, unless the other one costs clearly less (Eq. II.20).

        Where the judge doubts the tracked pose, the one that it takes for likelier.
        """
        if self._judge is not None and self._trust.doubtful:
            return max(tracked, found, key=lambda one: self._odds(depth, one))
        gain = self.config.gain * self._cost(tracked.pose, tracked.error)
        return found if self._cost(found.pose, found.error) < gain else tracked

    def _scene_search(self, frames: int) -> SceneSearch:
        config = self.config
        return SceneSearch(
            self._hand, self._camera, self._forest, config=config.scene, fit=config.fit,
            search=config.search, finalists=config.finalists, frames=frames, **self._options,
        )  # fmt: skip

    def find_all(self, depths: NDArray[np.float32]) -> list[Estimate]:
        """The hand in independent frames, without memory of any.

        Args:
            depths: Clean depth [m], shape (n, height, width).
        """
        self.forget()
        if self._batch is None:
            self._batch = self._scene_search(BATCH)
        # Shapes are fitted to what is found here, where all restarts near a pose pay more.
        results = search_until(
            self._batch, depths, self._batch.regions(depths), self._hand, self._costs, self._rng,
            odds=self._odds, convinced=self._trust.convinced, attempts=self.config.attempts,
            turned=0.0,
        )  # fmt: skip
        return [
            self._estimate(found, self._trust.believes_alone(odds), {}) for found, odds in results
        ]

    def first_looks(self, depth: NDArray[np.float32]) -> Iterator[tuple[Found, ShapedHand]]:
        """What is found in a frame alone, before and after its size is adapted, and whose it is.

        The judge learns from it; see `models/build_judge.py`.

        Args:
            depth: Clean depth [m], shape (height, width).
        """
        self.forget()
        found = self._search_scene(depth, None, self._scene.regions(depth[None]))
        if found is not None:
            yield found, self._hand
            found, resized = self._sized(depth, found, settle=True, watch=False)
            if resized:
                yield found, self._hand

    def _costs(self, candidates: Candidates) -> Float:
        """E_c of Eq. II.20 [m], with what the forest says and what E_d cannot see."""
        temporal = [self._cost(pose, 0.0) for pose in candidates.poses]
        absent = self.config.presence_weight * (1.0 - candidates.presence)
        return (
            candidates.errors
            + temporal
            + absent
            + misplacement(candidates, self._hand, self._camera)
        )

    def _search_as_thesis(
        self, depth: NDArray[np.float32], regions: Callable[[], list[list[HandRegion]]]
    ) -> Found | None:
        """Steps 1 to 5: every frame is searched, the last pose is one candidate of the pool."""
        last = self._pose if self._sure else None
        if last is None:
            return self._search_scene(depth, None, regions())
        centre = keypoints(self._hand, last).mean(axis=0)
        candidates = self._near.run(depth, centre[None], extra=last[None], reference=last)
        best = int(np.argmin(self._costs(candidates)))
        return Found(
            pose=candidates.poses[best], error=float(candidates.errors[best]), presence=None,
            information=None,
        )  # fmt: skip

    def _cost(self, pose: Float, error: float) -> float:
        """E_c of Eq. II.20 [m]; the temporal term counts only where tracking can be trusted."""
        if not self._sure or self._pose is None or self._doubt.young:
            return error
        change = pose_difference(pose, self._pose)
        change[:3] *= 10.0  # in decimetres
        return error + self.config.temporal_weight * float(change @ change)

    def _fit(self, depth: NDArray[np.float32], starts: Float) -> Found:
        """The lowest depth error among the followed poses."""
        pose, error, information = fit_best(self._follower, self._hand, depth, starts)
        return Found(pose=pose, error=error, presence=None, information=information)
