"""Gaussian over the 21 joint angles, learnt from recorded motion by PCA."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE
from handtrack.hand.skeleton import NANGLE

FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianPrior:
    """Probabilistic PCA of joint angles: leading axes with their variances, the rest isotropic."""

    mean: NDArray[np.float64]
    """Mean joint angles [rad], shape (21,)."""
    axes: NDArray[np.float64]
    """Orthonormal principal axes, shape (21, k)."""
    variances: NDArray[np.float64]
    """Variances along the axes [rad^2], shape (k,)."""
    residual_variance: float
    """Variance of every direction outside the axes [rad^2]."""

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance [rad^2], shape (21, 21)."""
        extra = self.variances - self.residual_variance
        spread = (self.axes * extra) @ self.axes.T
        return np.asarray(spread + self.residual_variance * np.eye(NANGLE), np.float64)

    @property
    def precision(self) -> NDArray[np.float64]:
        """Inverse of the covariance, shape (21, 21)."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    def sample(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw joint angles [rad], shape (count, 21)."""
        return rng.multivariate_normal(self.mean, self.covariance, size=count, method="cholesky")

    @classmethod
    def learn(cls, angles: ArrayLike, *, explained: float = 0.95) -> GaussianPrior:
        """Learn from joint angles [rad], shape (n, 21), keeping axes for that share of variance.

        Raises:
            InputError: Too few or malformed samples.
        """
        angles = np.asarray(angles, np.float64)
        if angles.ndim != 2 or angles.shape[1] != NANGLE or len(angles) <= NANGLE:
            raise InputError(f"angles have shape {angles.shape}; expected (n > {NANGLE}, {NANGLE})")
        values, vectors = np.linalg.eigh(np.cov(angles.T))
        values, vectors = values[::-1], vectors[:, ::-1]
        count = int(np.searchsorted(np.cumsum(values) / values.sum(), explained) + 1)
        count = min(count, NANGLE - 1)
        return cls(
            mean=angles.mean(0),
            axes=vectors[:, :count],
            variances=values[:count],
            residual_variance=float(values[count:].mean()),
        )

    def save(self, path: str | Path, *, source: str, licence: str) -> None:
        """Write to .npz with its source and licence."""
        np.savez(
            path, format_version=FORMAT_VERSION, source=source, licence=licence, mean=self.mean,
            axes=self.axes, variances=self.variances, residual_variance=self.residual_variance,
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path | None = None) -> GaussianPrior:
        """Read a prior; without a path, the one that comes with handtrack.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is not a pose prior of a known format.
        """
        path = Path(path) if path is not None else artifact_path("pose_prior.npz")
        if not path.is_file():
            raise MissingFileError(f"no pose prior at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                if int(data["format_version"]) != FORMAT_VERSION:
                    raise DamagedFileError(f"{path} has an unknown format")
                return cls(
                    mean=data["mean"], axes=data["axes"], variances=data["variances"],
                    residual_variance=float(data["residual_variance"]),
                )  # fmt: skip
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is not a pose prior: {error}") from error
