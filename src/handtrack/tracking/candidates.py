"""Candidate poses of one frame: forest palms, refined, with fingers, refined again (II.5.1).

Steps 1, 2 and 4 of the thesis' hybrid tracking, for one or several places where the hand may be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.forest.artifact import Forest
from handtrack.forest.cascade import Cascade
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.tracking.best_fit import unit_poses
from handtrack.tracking.rescue import restart_poses, turned_over

Float = NDArray[np.float64]

APART = 0.005
"""Candidates whose keypoints differ by less than this on average are one [m]."""

OUT_OF_VIEW = 0.03
"""Cost of a candidate whose keypoints are all outside of the image [m]; pixels that nobody sees
cannot contradict it."""

FREE_REACH = 0.08
"""Distance of a candidate's middle from where it was looked for that costs nothing [m]."""

REACH_COST = 0.2
"""Cost of each metre beyond it [m]."""

SCORE_SHARE = 0.5
"""Weight of segmentation's score beside the forest's chance that a place holds a hand."""


def palm_step(fit: FitConfig) -> FitConfig:
    """One iteration that moves palms alone (step 1)."""
    return replace(
        fit, iterations=1, palm_only=True, silhouette_weight=0.0, front_weight=0.0,
        collision_weight=0.0, prior_weight=0.0, levenberg=False,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Refined poses of one frame."""

    poses: Float
    """Poses, shape (n, 28)."""
    errors: Float
    """Their depth errors E_d [m], shape (n,)."""
    centres: Float
    """Middle of the place where each was looked for [m], shape (n, 3)."""
    presence: Float
    """Chance that a hand is in that place at all, shape (n,)."""

    def best(self, costs: Float, count: int, hand: ShapedHand) -> Candidates:
        """The candidates of lowest cost that differ from each other, the best first.

        Args:
            costs: Cost of each, shape (n,).
            count: So many at most.
            hand: Whose poses they are.
        """
        order = np.argsort(costs, kind="stable")
        points = keypoints(hand, self.poses[order])
        chosen = [0]
        for row in range(1, len(order)):
            if len(chosen) == count:
                break
            gaps = np.linalg.norm(points[chosen] - points[row], axis=-1).mean(axis=-1)
            if gaps.min() > APART:
                chosen.append(row)
        return self.take(order[chosen])

    def take(self, rows: NDArray[np.intp]) -> Candidates:
        """Some of the candidates."""
        return Candidates(
            poses=self.poses[rows], errors=self.errors[rows], centres=self.centres[rows],
            presence=self.presence[rows],
        )  # fmt: skip


def misplacement(candidates: Candidates, hand: ShapedHand, camera: Camera) -> Float:
    """What E_d cannot see: keypoints outside of the image, far from the place searched [m]."""
    points = keypoints(hand, candidates.poses)
    pixels = camera.project(points)
    size = np.array([camera.width, camera.height])
    # NaN, a point behind the camera, is not inside.
    inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=-1)
    away = np.linalg.norm(points.mean(axis=1) - candidates.centres, axis=-1)
    reach = REACH_COST * np.maximum(away - FREE_REACH, 0.0)
    return OUT_OF_VIEW * (1.0 - inside.mean(axis=1)) + reach


class CandidateSearch:
    """Everything allocated for searching a fixed number of places in a frame."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        forest: Forest,
        *,
        fit: FitConfig,
        places: int,
        extra: int = 0,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            forest: The regressor.
            fit: Refinement of all candidates (step 4).
            places: Places that are searched at a time.
            extra: Poses of the caller's that join the pool of every place.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self._hand, self._camera, self.places, self.extra = hand, camera, places, extra
        self._cascade = Cascade(
            forest, [hand.as_right()] * places, camera, side=hand.side, device=device, graph=graph
        )
        self.modes = self._cascade.mode_count
        hands = [hand] * places

        def fitter(config: FitConfig, rows: int) -> Fitter:
            return Fitter(hands, camera, config=config, nhyp=rows, device=device, graph=graph)

        self._palms = fitter(palm_step(fit), self.modes)
        self._search = fitter(fit, self.modes + extra)

    def resize(self, hand: ShapedHand) -> None:
        """Go on with the same hand at another scale."""
        self._hand = hand
        self._cascade.resize([hand.as_right()] * self.places)
        for fitter in (self._palms, self._search):
            fitter.resize([hand] * self.places)

    def warm_up(self) -> None:
        """Compile the kernels and capture the graphs, on an empty image."""
        depth = np.zeros(self._camera.shape, np.float32)
        ahead = np.tile([0.0, 0.0, 0.5], (self.places, 1))
        pose = np.zeros((self.extra, 28))
        pose[:, 2], pose[:, 3] = 0.5, 1.0
        for _ in range(2):
            self.run(depth, ahead, extra=pose)

    def run(
        self,
        depth: NDArray[np.float32],
        centres: ArrayLike,
        *,
        wrists: ArrayLike | None = None,
        scores: ArrayLike = 1.0,
        extra: ArrayLike | None = None,
        reference: ArrayLike | None = None,
    ) -> Candidates:
        """Search all places.

        Args:
            depth: Clean depth [m], shape (height, width), or one for each place.
            centres: About the middle of each hand [m], shape (places, 3).
            wrists: Where each hand joins an arm [m], NaN where it does not, shape (places, 3).
            scores: What segmentation says of each place, 0 to 1, shape (places,).
            extra: Poses that join the pool of every place, shape (extra, 28).
            reference: Pose that smoothness pulls to (Eq. II.24), shape (28,); each candidate's own
                start when None.

        Returns:
            All refined candidates, place by place.
        """
        centres = np.asarray(centres, np.float64).reshape(self.places, 3)
        self._cascade.load(depth, centres, wrists)
        palms, _ = self._cascade.run_palms()
        # The middle of what the forest found is a better centre than the region's.
        middle = np.median(keypoints(self._hand, palms).mean(axis=2), axis=1)
        palms = self._refine(self._palms, depth, middle, palms)
        starts = self._cascade.run_fingers(palms)
        if self.extra:
            added = np.broadcast_to(np.asarray(extra, np.float64), (self.places, self.extra, 28))
            starts = np.concatenate([starts, added], axis=1)
        rows = starts.shape[1]
        poses = self._refine(self._search, depth, middle, starts, reference)
        seen, told = self._cascade.presence(), np.broadcast_to(scores, self.places)
        chance = (seen + SCORE_SHARE * told) / (1.0 + SCORE_SHARE)
        return Candidates(
            poses=poses.reshape(-1, 28), errors=self._search.errors.astype(np.float64),
            centres=np.repeat(centres, rows, axis=0),
            presence=np.repeat(chance, rows),
        )  # fmt: skip

    def _refine(
        self,
        fitter: Fitter,
        depth: NDArray[np.float32],
        centres: Float,
        starts: Float,
        reference: ArrayLike | None = None,
    ) -> Float:
        """Refined poses, shape (places, rows, 28)."""
        fitter.load_depth(np.broadcast_to(depth, (self.places, *depth.shape[-2:])))
        fitter.place(centres)
        flat = starts.reshape(-1, 28)
        pull = None if reference is None else np.broadcast_to(np.asarray(reference), flat.shape)
        fitter.set_poses(flat, pull)
        fitter.run()
        return unit_poses(fitter).reshape(starts.shape)


class Refinement:
    """Refines candidates of several frames, as many of each, against their own images."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        fit: FitConfig,
        frames: int,
        rows: int,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            fit: The fit.
            frames: Frames refined at a time.
            rows: Candidates of each.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self._hand, self.frames, self.rows = hand, frames, rows
        self.fitter = Fitter(
            [hand] * frames, camera, config=fit, nhyp=rows, device=device, graph=graph
        )
        self.fitter.warm_up()

    def resize(self, hand: ShapedHand) -> None:
        """Go on with the same hand at another scale."""
        self._hand = hand
        self.fitter.resize([hand] * self.frames)

    def run(self, depths: NDArray[np.float32], starts: list[Candidates]) -> list[Candidates]:
        """Refine the candidates of every frame.

        Args:
            depths: Clean depth [m], shape (frames, height, width).
            starts: At most `rows` candidates of each frame; the last one fills up.

        Returns:
            As many candidates of each frame as were given, in the same order.
        """
        rows = [np.minimum(np.arange(self.rows), len(one.poses) - 1) for one in starts]
        poses = np.stack([one.poses[row] for one, row in zip(starts, rows, strict=True)])
        self.fitter.load_depth(depths)
        self.fitter.place(keypoints(self._hand, poses[:, 0]).mean(axis=1))
        self.fitter.set_poses(poses.reshape(-1, 28))
        self.fitter.run()
        found = unit_poses(self.fitter).reshape(poses.shape)
        errors = self.fitter.errors.astype(np.float64).reshape(self.frames, self.rows)
        return [
            replace(one, poses=found[k, : len(one.poses)], errors=errors[k, : len(one.poses)])
            for k, one in enumerate(starts)
        ]


def restarts_around(
    elite: Candidates, rows: int, hand: ShapedHand, rng: np.random.Generator, *, turned: float
) -> Candidates:
    """Candidates and random restarts around them, `rows` in all.

    Args:
        elite: Candidates to start from.
        rows: How many in all.
        hand: Whose poses they are.
        rng: Source of the random numbers.
        turned: Share of the restarts that are turned over as well.
    """
    owner = np.arange(rows) % len(elite.poses)
    poses = elite.poses[owner]
    for k in range(len(elite.poses)):
        mine = np.flatnonzero(owner == k)[1:]
        poses[mine] = restart_poses(hand, elite.poses[k], len(mine), rng)
        over = mine[rng.random(len(mine)) < turned]
        poses[over] = turned_over(hand, poses[over], rng)
    return replace(elite.take(owner), poses=poses)
