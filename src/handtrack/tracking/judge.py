"""Whether a fitted pose is a hand in that pose: the chance, learnt from scenes with and without.

A logistic regression on E_d, on the likeness of depth and rendered hand, and, where a place has
just been searched, on what the forest says of that place. `models/build_judge.py` learns it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.artifacts import artifact_path
from handtrack.camera.camera import Camera
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.hand.model import ShapedHand
from handtrack.tracking.likeness import FEATURES, HandLikeness

FORMAT_VERSION = 1

STEADY = 3.0
"""Features count up to so many deviations from their mean."""

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeModel:
    """Weights of the logistic regression."""

    mean: Float
    """Mean of E_d [cm], the place's presence, and each of `FEATURES`, shape (17,)."""
    deviation: Float
    """Their standard deviations, shape (17,)."""
    weights: Float
    """Weights of the standardised features, with presence and without, shape (2, 17)."""
    intercepts: Float
    """Log-odds at the mean, shape (2,)."""

    def log_odds(self, features: ArrayLike, *, placed: bool = True) -> Float:
        """Log-odds that a pose is right, shape (...).

        Args:
            features: E_d [cm], presence, `FEATURES`, shape (..., 17). NaN, nothing to compare, is
                as bad as can be.
            placed: Whether the place's presence is known.
        """
        features = np.asarray(features, np.float64)
        standard = np.clip((features - self.mean) / self.deviation, -STEADY, STEADY)
        row = 0 if placed else 1
        odds = self.intercepts[row] + np.nan_to_num(standard) @ self.weights[row]
        return np.where(np.isfinite(features).all(axis=-1), odds, -np.inf)

    @classmethod
    def learn(cls, features: ArrayLike, right: ArrayLike) -> JudgeModel:
        """Learn from judged poses.

        Args:
            features: As for `log_odds`, shape (n, 17).
            right: Whether each pose is right, shape (n,).

        Raises:
            InputError: There are no right or no wrong poses among them.
        """
        from sklearn.linear_model import LogisticRegression

        features, right = np.asarray(features, np.float64), np.asarray(right, bool)
        if features.ndim != 2 or features.shape[1] != 2 + len(FEATURES):
            raise InputError(
                f"features have shape {features.shape}; expected (n, {2 + len(FEATURES)})"
            )
        if not 0 < right.sum() < len(right):
            raise InputError(
                f"{right.sum()} of {len(right)} poses are right; expected some of both"
            )
        mean, deviation = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
        standard = np.clip((features - mean) / deviation, -STEADY, STEADY)
        unplaced = standard.copy()
        unplaced[:, 1] = 0.0
        fits = [LogisticRegression(max_iter=1000).fit(part, right) for part in (standard, unplaced)]
        return cls(
            mean=mean, deviation=deviation, weights=np.stack([fit.coef_[0] for fit in fits]),
            intercepts=np.array([fit.intercept_[0] for fit in fits]),
        )  # fmt: skip

    def save(self, path: str | Path, *, source: str) -> None:
        """Write to .npz, with what it was learnt from."""
        with whole_file(Path(path)) as file:
            np.savez(
                file, format_version=FORMAT_VERSION, source=source, licence="Apache-2.0",
                features=np.array(["depth error", "presence", *FEATURES]), mean=self.mean,
                deviation=self.deviation, weights=self.weights, intercepts=self.intercepts,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path | None = None) -> JudgeModel:
        """Read a model; without a path, the one that comes with handtrack.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is none, or judges by other features.
        """
        path = Path(path) if path is not None else artifact_path("judge.npz")
        if not path.is_file():
            raise MissingFileError(f"no judge at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                if int(data["format_version"]) != FORMAT_VERSION:
                    raise DamagedFileError(f"{path} has an unknown format")
                if data["features"].tolist()[2:] != list(FEATURES):
                    raise DamagedFileError(f"{path} judges by other features; build it again")
                return cls(
                    mean=data["mean"], deviation=data["deviation"], weights=data["weights"],
                    intercepts=data["intercepts"],
                )  # fmt: skip
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is not a judge: {error}") from error


def judge_features(
    likeness: HandLikeness, depth: NDArray[np.float32], pose: Float, error: float,
    presence: float | None,
) -> Float:  # fmt: skip
    """What a pose is judged by, shape (17,); arguments as for `HandJudge.log_odds`."""
    place = 0.0 if presence is None else presence
    return np.concatenate([[1e2 * error, place], likeness.measure(depth, pose)])


class HandJudge:
    """Judges fitted poses of one hand in images of one camera."""

    def __init__(self, hand: ShapedHand, camera: Camera, *, device: str | None = None) -> None:
        """Allocate; arguments as for `HandLikeness`."""
        self._model = JudgeModel.load()
        self._likeness = HandLikeness(hand, camera, device=device)

    def resize(self, hand: ShapedHand) -> None:
        """Go on with another hand."""
        self._likeness.resize(hand)

    def log_odds(
        self, depth: NDArray[np.float32], pose: Float, error: float, presence: float | None = None
    ) -> float:
        """Log-odds that a hand is there in that pose.

        Args:
            depth: Clean depth [m], shape (height, width).
            pose: Fitted pose, shape (28,).
            error: Its depth error E_d [m].
            presence: Chance of its place to hold a hand; None when it was not asked for.
        """
        features = judge_features(self._likeness, depth, pose, error, presence)
        return float(self._model.log_odds(features, placed=presence is not None))
