"""Models of how hands close, one per grip mode, learnt from recordings (thesis III.4.1.1).

Motions are registered to a reference, their shapes and their time warps each described by a few
weights (functional PCA, Eq. III.1 and III.2), and the weights' joint density by a Gaussian mixture.
A weight of one is one standard deviation of the examples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp
from sklearn.mixture import GaussianMixture

from handtrack.errors import InputError
from handtrack.grasp.recording import FRAME_RATE, GraspDatabase, GraspRecording
from handtrack.grasp.warping import log_increments, registered, resampled, unwarped, warp_of
from handtrack.hand.skeleton import NV
from handtrack.transforms import apply_increment, pose_difference

Float = NDArray[np.float64]

SCALES = np.concatenate([np.full(3, 0.02), np.full(NV - 3, 0.25)])
"""Departures that count the same: of the palm's place [m], its orientation and angles [rad]."""

FEWEST_RECORDINGS = 3
"""Fewest recordings that a grip mode can be learnt from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionModelConfig:
    """Settings of learning."""

    shape_variance: float = 0.97
    """Share of the variance of the motions' shapes that the modes must hold."""
    most_shape_modes: int = 12
    """Most modes of shape."""
    time_variance: float = 0.9
    """Share of the variance of the time warps that their modes must hold."""
    most_time_modes: int = 3
    """Most modes of time."""
    most_components: int = 3
    """Most components of the Gaussian mixture; the Bayes information criterion chooses."""
    covariance_floor: float = 0.02
    """Added to the variances of the mixture, in squared standard deviations of the examples."""
    seed: int = 0
    """Seed of expectation maximisation's start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GripModel:
    """Closing motions of one grip mode, in the grasp frame."""

    grip: str
    """Name of the grip mode."""
    base: Float
    """Pose that motions are told from: mean orientation of the grasps, all else 0, shape (28,)."""
    shape_mean: Float
    """p_0: mean motion as increments from `base`, shape (nref, 27)."""
    shape_modes: Float
    """p_m, each one standard deviation long, shape (nshape, nref, 27)."""
    time_mean: Float
    """b_0: mean log increments of the time warps [ln frames], shape (nref - 1,)."""
    time_modes: Float
    """b_k, each one standard deviation long, shape (ntime, nref - 1)."""
    shares: Float
    """Weights of the mixture's components, shape (ncomponent,)."""
    means: Float
    """Their means, shape (ncomponent, nweight)."""
    factors: Float
    """Lower Cholesky factors of their covariances, shape (ncomponent, nweight, nweight)."""
    examples: Float
    """Weights of the recordings that were learnt from, shape (nexample, nweight)."""
    example_objects: tuple[str, ...]
    """Names of the objects in those recordings."""

    @property
    def nshape(self) -> int:
        """Number of shape weights alpha; they come first."""
        return len(self.shape_modes)

    @property
    def ntime(self) -> int:
        """Number of time weights gamma."""
        return len(self.time_modes)

    @property
    def nweight(self) -> int:
        """Number of weights of a motion: alpha, then gamma."""
        return self.nshape + self.ntime

    def sample(self, rng: np.random.Generator, count: int) -> Float:
        """Draw weights from the mixture, shape (count, nweight)."""
        chosen = rng.choice(len(self.shares), size=count, p=self.shares)
        noise = rng.standard_normal((count, self.nweight))
        return self.means[chosen] + np.einsum("nij,nj->ni", self.factors[chosen], noise)

    def log_density(self, weights: ArrayLike) -> Float:
        """Log density ln pr(alpha, gamma), shape (n,), of weights, shape (n, nweight)."""
        weights = self._checked(weights)
        terms = np.empty((len(self.shares), len(weights)))
        for k, (share, mean, factor) in enumerate(
            zip(self.shares, self.means, self.factors, strict=True)
        ):
            white = solve_triangular(factor, (weights - mean).T, lower=True)
            volume = np.log(np.diag(factor)).sum() + 0.5 * self.nweight * np.log(2.0 * np.pi)
            terms[k] = np.log(share) - 0.5 * (white**2).sum(0) - volume
        return np.asarray(logsumexp(terms, axis=0), np.float64)

    def warps(self, weights: ArrayLike) -> Float:
        """H(t; gamma) [frames], shape (n, nref), of weights, shape (n, nweight) (Eq. III.2)."""
        weights = self._checked(weights)
        return warp_of(self.time_mean + weights[:, self.nshape :] @ self.time_modes)

    def durations(self, weights: ArrayLike) -> Float:
        """How long the motions take [s], shape (n,), of weights, shape (n, nweight)."""
        return self.warps(weights)[:, -1] / FRAME_RATE

    def increments(self, weights: ArrayLike, nframe: int) -> Float:
        """Motions as increments from `base`, shape (n, nframe, 27) (Eq. III.3).

        Args:
            weights: Shape (n, nweight).
            nframe: Number of frames, spread evenly over each motion's duration.
        """
        weights = self._checked(weights)
        modes = self.shape_modes.reshape(self.nshape, -1)
        moved = (weights[:, : self.nshape] @ modes).reshape(len(weights), *self.shape_mean.shape)
        return unwarped(self.shape_mean + moved, self.warps(weights), nframe)

    def motions(self, weights: ArrayLike, nframe: int) -> Float:
        """Hand poses in the grasp frame, shape (n, nframe, 28); arguments as of `increments`."""
        return apply_increment(self.base, self.increments(weights, nframe))

    def motion(self, alpha: ArrayLike, gamma: ArrayLike) -> tuple[Float, Float]:
        """One motion at `FRAME_RATE`.

        Returns:
            Times [s], shape (nframe,), and hand poses in the grasp frame, shape (nframe, 28).
        """
        weights = np.concatenate([np.ravel(alpha), np.ravel(gamma)])[None]
        duration = float(self.durations(weights)[0])
        nframe = max(round(duration * FRAME_RATE) + 1, 2)
        return np.linspace(0.0, duration, nframe), self.motions(weights, nframe)[0]

    def _checked(self, weights: ArrayLike) -> Float:
        weights = np.asarray(weights, np.float64)
        if weights.ndim != 2 or weights.shape[1] != self.nweight:
            raise InputError(
                f"weights of {self.grip} have shape {weights.shape}; expected (n, {self.nweight})"
            )
        return weights


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspMotionModel:
    """Models of all grip modes."""

    grips: Mapping[str, GripModel]
    """Models by name of the grip mode."""

    @classmethod
    def load(cls) -> GraspMotionModel:
        """Learn from the database that comes with handtrack."""
        return cls.learn(GraspDatabase.load())

    @classmethod
    def learn(
        cls, database: GraspDatabase, config: MotionModelConfig | None = None
    ) -> GraspMotionModel:
        """Learn every grip mode that a database has enough recordings of.

        Raises:
            InputError: There is no grip mode with three recordings.
        """
        enough = [g for g in database.grips if len(database.of_grip(g)) >= FEWEST_RECORDINGS]
        if not enough:
            raise InputError(
                f"no grip mode has {FEWEST_RECORDINGS} recordings or more among {len(database)}"
            )
        return cls(grips={g: learn_grip(g, database.of_grip(g), config) for g in enough})

    def __getitem__(self, grip: str) -> GripModel:
        """The model of one grip mode.

        Raises:
            InputError: There is none.
        """
        if grip not in self.grips:
            raise InputError(f"no motions of grip {grip!r}; there are {', '.join(self.grips)}")
        return self.grips[grip]


def learn_grip(
    grip: str, recordings: Sequence[GraspRecording], config: MotionModelConfig | None = None
) -> GripModel:
    """Learn one grip mode from the closing phases of its recordings.

    Raises:
        InputError: There are fewer than three recordings.
    """
    config = config or MotionModelConfig()
    if len(recordings) < FEWEST_RECORDINGS:
        raise InputError(
            f"{len(recordings)} recordings of {grip}; expected at least {FEWEST_RECORDINGS}"
        )
    poses = [recording.closing_in_grasp_frame for recording in recordings]
    base = np.zeros(28)
    grasps = np.array([motion[-1, 3:7] for motion in poses])
    mean = Rotation.from_quat(grasps, scalar_first=True).mean()
    base[3:7] = mean.as_quat(canonical=True, scalar_first=True)
    moves = [pose_difference(motion, base) for motion in poses]
    reference = moves[_medoid(moves)] / SCALES
    warps = registered(reference, [motion / SCALES for motion in moves])
    shapes = np.array([resampled(m, w) for m, w in zip(moves, warps, strict=True)])
    shape_mean, shape_modes, alphas = _components(
        (shapes / SCALES).reshape(len(shapes), -1), config.shape_variance, config.most_shape_modes
    )
    time_mean, time_modes, gammas = _components(
        log_increments(np.array(warps)), config.time_variance, config.most_time_modes
    )
    weights = np.concatenate([alphas, gammas], axis=1)
    shares, means, factors = _mixture(weights, config)
    return GripModel(
        grip=grip, base=base,
        shape_mean=shape_mean.reshape(-1, NV) * SCALES,
        shape_modes=shape_modes.reshape(len(shape_modes), -1, NV) * SCALES,
        time_mean=time_mean, time_modes=time_modes, shares=shares, means=means, factors=factors,
        examples=weights, example_objects=tuple(recording.object for recording in recordings),
    )  # fmt: skip


def _medoid(motions: Sequence[Float]) -> int:
    """Number of the motion that is nearest to all others."""
    even = np.array([resampled(m, np.linspace(0, len(m) - 1, 20)) / SCALES for m in motions])
    apart = np.linalg.norm((even[:, None] - even[None]).reshape(len(even), len(even), -1), axis=2)
    return int(apart.sum(1).argmin())


def _components(rows: Float, variance: float, most: int) -> tuple[Float, Float, Float]:
    """Mean, modes (nmode, n) of one standard deviation, and weights (nrow, nmode) of rows."""
    mean = rows.mean(0)
    centred = rows - mean
    # A motion has far more numbers than there are motions: their products are the smaller matrix.
    variances, left = np.linalg.eigh(centred @ centred.T / (len(rows) - 1))
    variances, left = variances[::-1].clip(1e-18, None), left[:, ::-1]
    held = np.cumsum(variances) / variances.sum()
    count = min(int(np.searchsorted(held, variance)) + 1, most, len(rows) - 1)
    weights = left[:, :count] * np.sqrt(len(rows) - 1)
    return mean, weights.T @ centred / (len(rows) - 1), weights


def _mixture(weights: Float, config: MotionModelConfig) -> tuple[Float, Float, Float]:
    """Shares, means and Cholesky factors of the mixture that fits best for its size."""
    count, size = weights.shape
    # A component needs more examples than it has dimensions, or its covariance is the floor's.
    most = max(1, min(config.most_components, count // (size + 1)))
    fits = [
        GaussianMixture(
            components,
            reg_covar=config.covariance_floor,
            random_state=config.seed,
            n_init=2,
            init_params="random_from_data",
        ).fit(weights)
        for components in range(1, most + 1)
    ]
    best = min(fits, key=lambda fit: fit.bic(weights))
    shares, means, covariances = (
        np.asarray(part, np.float64) for part in (best.weights_, best.means_, best.covariances_)
    )
    return shares, means, np.asarray(np.linalg.cholesky(covariances), np.float64)
