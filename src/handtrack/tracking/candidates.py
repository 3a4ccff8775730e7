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

Float = NDArray[np.float64]


def palm_step(fit: FitConfig) -> FitConfig:
    """One iteration that moves palms alone (step 1)."""
    return replace(
        fit, iterations=1, palm_only=True, silhouette_weight=0.0, front_weight=0.0,
        collision_weight=0.0, prior_weight=0.0, levenberg=False,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Refined poses of one frame, the best first."""

    poses: Float
    """Poses, shape (n, 28)."""
    errors: Float
    """Their depth errors E_d [m], shape (n,)."""
    places: NDArray[np.int64]
    """Place that each was looked for in, shape (n,)."""


class CandidateSearch:
    """Everything allocated for searching a fixed number of places in a frame."""

    def __init__(
        self,
        hand: ShapedHand,
        right_hand: ShapedHand,
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
            right_hand: The right hand of the same shape, which forests know.
            camera: Camera of the depth images.
            forest: The regressor.
            fit: Refinement of all candidates (step 4).
            places: Places that are searched at a time.
            extra: Poses of the caller's that join the pool of every place.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.
        """
        self._hand, self.places, self.extra = hand, places, extra
        self._cascade = Cascade(
            forest, [right_hand] * places, camera, side=hand.side, device=device, graph=graph
        )
        self.modes = self._cascade.mode_count
        hands = [hand] * places

        def fitter(config: FitConfig, rows: int) -> Fitter:
            return Fitter(hands, camera, config=config, nhyp=rows, device=device, graph=graph)

        self._palms = fitter(palm_step(fit), self.modes)
        self._search = fitter(fit, self.modes + extra)

    def warm_up(self) -> None:
        """Compile the kernels and capture the graphs, on an empty image."""
        camera = self._palms.camera
        depth = np.zeros(camera.shape, np.float32)
        ahead = np.tile([0.0, 0.0, 0.5], (self.places, 1))
        pose = np.zeros((self.extra, 28))
        pose[:, 2], pose[:, 3] = 0.5, 1.0
        for _ in range(2):
            self.run(depth, ahead, extra=pose)

    def propose(self, depth: NDArray[np.float32], centres: ArrayLike) -> tuple[Float, Float]:
        """Poses as the forest gives them.

        Args:
            depth: Clean depth [m], shape (height, width), or one for each place.
            centres: About the middle of each hand [m], shape (places, 3).

        Returns:
            Poses, shape (places, modes, 28), and their votes' weights, shape (places, modes).
        """
        self._cascade.load(depth, centres)
        palms, weights = self._cascade.run_palms()
        return self._cascade.run_fingers(palms), weights.astype(np.float64)

    def run(
        self,
        depth: NDArray[np.float32],
        centres: ArrayLike,
        *,
        extra: ArrayLike | None = None,
        reference: ArrayLike | None = None,
    ) -> Candidates:
        """Search all places.

        Args:
            depth: Clean depth [m], shape (height, width), or one for each place.
            centres: About the middle of each hand [m], shape (places, 3).
            extra: Poses that join the pool, shape (extra, 28).
            reference: Pose that smoothness pulls to (Eq. II.24), shape (28,); each candidate's own
                start when None.

        Returns:
            All refined candidates, the lowest depth error first.
        """
        self._cascade.load(depth, centres)
        palms, _ = self._cascade.run_palms()
        # The middle of what the forest found is a better centre than the region's.
        middle = np.median(keypoints(self._hand, palms).mean(axis=2), axis=1)
        palms = self._refine(self._palms, depth, middle, palms)
        starts = self._cascade.run_fingers(palms)
        if self.extra:
            added = np.broadcast_to(np.asarray(extra, np.float64), (self.places, self.extra, 28))
            starts = np.concatenate([starts, added], axis=1)
        poses = self._refine(self._search, depth, middle, starts, reference).reshape(-1, 28)
        errors = self._search.errors.astype(np.float64)
        order = np.argsort(errors, kind="stable")
        return Candidates(
            poses=poses[order], errors=errors[order], places=order // (self.modes + self.extra)
        )

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
        references = (
            None if reference is None else np.broadcast_to(np.asarray(reference), flat.shape)
        )
        fitter.set_poses(flat, references)
        fitter.run()
        poses = fitter.poses.astype(np.float64)
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        return poses.reshape(starts.shape)
