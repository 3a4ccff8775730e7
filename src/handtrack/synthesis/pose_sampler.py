"""Joint angles for training data: named poses with perturbations, and samples of a learnt prior."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.hand.skeleton import NANGLE
from handtrack.priors.gaussian import GaussianPrior
from handtrack.synthesis.collision import HandSpheres

Float = NDArray[np.float64]

CANDIDATES = 16
"""Poses drawn at once; the first whose fingers keep apart is taken."""


class PoseSampler:
    """Draws joint angles of one hand, inside its limits, whose fingers do not pass each other."""

    def __init__(
        self,
        spheres: HandSpheres,
        prior: GaussianPrior,
        *,
        perturbation: float,
        max_penetration: float,
    ) -> None:
        """Prepare.

        Args:
            spheres: Spheres of the hand that takes the poses.
            prior: Recorded poses' statistics; perturbations have its correlations, since fingers
                move together.
            perturbation: Standard deviation of every angle about a named pose [rad].
            max_penetration: Deepest overlap that is let pass [m]; flesh gives way.
        """
        self._spheres, self._prior = spheres, prior
        self._max_penetration = max_penetration
        spread = np.sqrt(np.diag(prior.covariance))
        correlation = prior.covariance / np.outer(spread, spread)
        self._perturb = perturbation * np.linalg.cholesky(correlation)

    def around(self, angles: ArrayLike, rng: np.random.Generator) -> Float:
        """A perturbed pose.

        Args:
            angles: The pose to perturb [rad], shape (21,).
            rng: Source of the random numbers.

        Returns:
            Joint angles [rad], shape (21,).
        """
        angles = np.asarray(angles, np.float64)
        if angles.shape != (NANGLE,):
            raise InputError(f"angles have shape {angles.shape}: expected ({NANGLE},)")
        return self._pick(angles + rng.standard_normal((CANDIDATES, NANGLE)) @ self._perturb.T)

    def from_prior(self, rng: np.random.Generator) -> Float:
        """A pose like the recorded ones: joint angles [rad], shape (21,)."""
        return self._pick(self._prior.sample(rng, CANDIDATES))

    def _pick(self, candidates: Float) -> Float:
        """The first candidate whose fingers keep apart, or else the one with the least overlap."""
        candidates = candidates.clip(*self._spheres.hand.limits.T)
        depth = self._spheres.penetration(candidates)
        fits = np.flatnonzero(depth <= self._max_penetration)
        return candidates[fits[0] if len(fits) else int(depth.argmin())]
