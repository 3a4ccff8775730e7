"""The hand in whole scenes, without memory: regions, candidates in each, rounds of restarts.

One frame while tracking, several independent ones for `HandTracker.track_batch`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.segmentation import HandRegion, centres_of, find_hand_regions, wrists_of
from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig
from handtrack.fitting.uncertainty import FitInformation
from handtrack.forest.artifact import Forest
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.tracking.candidates import (
    Candidates,
    CandidateSearch,
    Refinement,
    restarts_around,
)

Float = NDArray[np.float64]

ELSEWHERE = 0.08
"""Places farther than this from a pose are others [m]."""

Cost = Callable[[Candidates], Float]
"""Cost of each candidate [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A pose with what decides about it."""

    pose: Float
    """Pose, shape (28,)."""
    error: float
    """Depth error E_d [m]."""
    presence: float | None
    """Chance that a hand is in the place where it was found; None when that was not asked."""
    information: FitInformation | None
    """What the fit knew of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchConfig:
    """How much is tried when nothing is known."""

    regions: int = 3
    """Places of the scene that are searched."""
    rounds: int = 5
    """Rounds of restarts around the best candidates."""
    rows: int = 24
    """Poses refined per round."""
    elites: int = 6
    """Candidates that each round starts from."""
    turned: float = 0.5
    """Share of the restarts that are turned over: another side of the hand, another direction."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for name, least in (("regions", 1), ("rounds", 0), ("rows", 1), ("elites", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least {least}")
        if not 0 <= self.turned <= 1:
            raise InputError(f"turned is {self.turned}; expected 0 to 1")


class SceneSearch:
    """Everything allocated for searching a fixed number of frames at a time."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        forest: Forest,
        *,
        config: SearchConfig,
        fit: FitConfig,
        search: FitConfig,
        finalists: int,
        frames: int = 1,
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            forest: The regressor.
            config: How much is tried.
            fit: The fit of the finalists.
            search: The refinement of all others.
            finalists: Candidates that are fitted to the end.
            frames: Frames searched at a time.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self._hand, self._camera, self._config = hand, camera, config
        self.frames = frames
        self._candidates = CandidateSearch(
            hand, camera, forest, fit=search, places=frames * config.regions, device=device,
            graph=graph,
        )  # fmt: skip
        self._candidates.warm_up()

        def refinement(fit: FitConfig, rows: int) -> Refinement:
            return Refinement(
                hand, camera, fit=fit, frames=frames, rows=rows, device=device, graph=graph
            )

        self._rounds = refinement(search, config.rows) if config.rounds else None
        self._final = refinement(fit, finalists)
        self._pool = ThreadPoolExecutor(2) if frames > 1 else None

    def resize(self, hand: ShapedHand) -> None:
        """Go on with the same hand at another scale."""
        self._hand = hand
        for part in (self._candidates, self._rounds, self._final):
            if part is not None:
                part.resize(hand)

    def run(
        self,
        depths: NDArray[np.float32],
        regions: list[list[HandRegion]],
        cost: Cost,
        rng: np.random.Generator,
        *,
        turned: float | None = None,
    ) -> list[Found | None]:
        """Search every frame.

        Args:
            depths: Clean depth [m], shape (frames, height, width).
            regions: Where, in each of them; see `regions`.
            cost: What the candidates are compared by.
            rng: Source of the random numbers.
            turned: Share of the restarts that are turned over; the configuration's when None.

        Returns:
            The best pose of each frame; None where nothing has the size of a hand.
        """
        empty = [not one for one in regions]
        if all(empty):
            return [None] * self.frames
        places = [self._filled(one) for one in regions]
        found = self._candidates.run(
            np.repeat(depths, self._config.regions, axis=0),
            np.concatenate([centres_of(one) for one in places]),
            wrists=np.concatenate([wrists_of(one) for one in places]),
            scores=np.array([region.score for one in places for region in one]),
        )
        per_frame = len(found.poses) // self.frames
        pools = [
            found.take(np.arange(k * per_frame, (k + 1) * per_frame)) for k in range(self.frames)
        ]
        if self._rounds is not None:
            turned = self._config.turned if turned is None else turned
            for _ in range(self._config.rounds):
                pools = self._rounds.run(depths, [
                    restarts_around(
                        pool.best(cost(pool), self._config.elites, self._hand),
                        self._config.rows, self._hand, rng, turned=turned,
                    )
                    for pool in pools
                ])  # fmt: skip
        return [
            None if nothing else found
            for nothing, found in zip(empty, self.finish(depths, pools, cost), strict=True)
        ]

    def finish(
        self, depths: NDArray[np.float32], pools: list[Candidates], cost: Cost
    ) -> list[Found]:
        """Fit the best candidates of every frame to the end; the best of them.

        Args:
            depths: Clean depth [m], shape (frames, height, width).
            pools: Candidates of each frame.
            cost: What they are compared by.
        """
        finals = self._final.run(
            depths, [pool.best(cost(pool), self._final.rows, self._hand) for pool in pools]
        )
        results = []
        for frame, final in enumerate(finals):
            best = int(np.argmin(cost(final)))
            results.append(Found(
                pose=final.poses[best], error=float(final.errors[best]),
                presence=float(final.presence[best]),
                information=self._final.fitter.information(frame * self._final.rows + best),
            ))  # fmt: skip
        return results

    def _filled(self, regions: list[HandRegion]) -> list[HandRegion]:
        """As many regions as are searched: a frame's best one takes the rows left over."""
        known = regions or [_NOWHERE]
        return known + [known[0]] * (self._config.regions - len(known))

    def regions(self, depths: NDArray[np.float32]) -> list[list[HandRegion]]:
        """Regions of each frame, the most plausible first."""

        def find(depth: NDArray[np.float32]) -> list[HandRegion]:
            return find_hand_regions(depth, self._camera, max_regions=self._config.regions)

        if self._pool is None:
            return [find(depth) for depth in depths]
        return list(self._pool.map(find, depths))


_NOWHERE = HandRegion(centre=np.array([0.0, 0.0, 0.5]), radius=0.1, box=(0, 0, 0, 0))
"""Stands for the regions of a frame without any, in batches."""


def search_until(
    scene: SceneSearch,
    depths: NDArray[np.float32],
    regions: list[list[HandRegion]],
    hand: ShapedHand,
    cost: Cost,
    rng: np.random.Generator,
    *,
    odds: Callable[[NDArray[np.float32], Found], float],
    convinced: Callable[[float], bool],
    attempts: int,
    turned: float | None = None,
) -> list[tuple[Found | None, float]]:
    """Search frames again, with new restarts and every other time elsewhere, until one convinces.

    Args:
        scene: Searches some frames at a time.
        depths: Clean depth [m], shape (n, height, width).
        regions: Where, in each of them; see `SceneSearch.regions`.
        hand: The person's hand.
        cost: What candidates are compared by.
        rng: Source of the random numbers.
        odds: Log-odds that a pose is a hand in an image.
        convinced: Whether log-odds are good enough to stop.
        attempts: Searches of a frame, at most.
        turned: As for `SceneSearch.run`.

    Returns:
        The likeliest pose of each frame and its log-odds; None where nothing has the size of a
        hand.
    """
    best: list[tuple[Found | None, float]] = [(None, -np.inf)] * len(depths)
    pending = [k for k in range(len(depths)) if regions[k]]
    for attempt in range(attempts):
        for first in range(0, len(pending), scene.frames):
            chosen = pending[first : first + scene.frames]
            part = np.zeros((scene.frames, *depths.shape[1:]), np.float32)
            part[: len(chosen)] = depths[chosen]
            places = [regions[k] for k in chosen]
            if attempt % 2:
                places = [_elsewhere(regions[k], best[k][0], hand) for k in chosen]
            places += [[]] * (scene.frames - len(chosen))
            results = scene.run(part, places, cost, rng, turned=turned)
            for k, found in zip(chosen, results, strict=False):
                assert found is not None
                likely = odds(depths[k], found)
                if best[k][0] is None or likely > best[k][1]:
                    best[k] = (found, likely)
        pending = [k for k in pending if not convinced(best[k][1])]
    return best


def _elsewhere(
    regions: list[HandRegion], found: Found | None, hand: ShapedHand
) -> list[HandRegion]:
    """Regions away from a pose that does not convince; all where there are no others."""
    assert found is not None
    middle = keypoints(hand, found.pose).mean(axis=0)
    others = [one for one in regions if np.linalg.norm(one.centre - middle) > ELSEWHERE]
    return others or regions
