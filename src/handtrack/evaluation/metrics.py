"""Error measures between predicted and true joint positions, in millimetres and float64.

Positions come in metres, camera frame, frame axis first; every error leaves in millimetres. The
same functions serve the 21 keypoints of our own results and the joint sets of the published
protocols.

A joint whose prediction is not finite counts as `MISSING_ERROR_MM` away from the truth. Means and
percentiles so stay finite numbers, a tracker gains nothing by leaving hard frames out, and such a
frame fails every success threshold below that distance; `AccuracySummary.missing_rate` tells how
many frames were concerned. The truth itself must be finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError

SUCCESS_THRESHOLDS_MM: tuple[float, ...] = (20.0, 30.0, 40.0)
"""Distances [mm] at which success rates are reported (Taylor et al. 2012, as used with NYU, ICVL
and MSRA)."""

LOST_THRESHOLD_MM = 20.0
"""A frame whose mean joint error [mm] is larger than this counts as lost."""

MISSING_ERROR_MM = 200.0
"""Error [mm] of a joint without a finite prediction: about the length of a hand."""

PHALANGES: tuple[tuple[int, int], ...] = tuple(
    (first + k, first + k + 1) for first in (1, 5, 9, 13, 17) for k in range(3)
)
"""The 15 phalanges (with the thumb's metacarpal) as pairs of keypoint indices, proximal end
first."""

PALM_SEGMENT: tuple[int, int] = (0, 9)
"""The palm as one more segment: wrist to the middle finger's MCP joint."""

SEGMENTS: tuple[tuple[int, int], ...] = (*PHALANGES, PALM_SEGMENT)
"""The 16 rigid segments of the hand that `phalanx_errors` measures."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AccuracySummary:
    """Accuracy over a set of frames; `to_dict` gives the keys of the benchmark file."""

    frames: int
    """Number of frames measured."""
    mean_mm: float
    """Mean error over all joints of all frames [mm]."""
    median_mm: float
    """Median error over all joints of all frames [mm]."""
    p95_mm: float
    """95th percentile of the error over all joints of all frames [mm]."""
    success_rate: dict[str, float]
    """Threshold [mm] as text -> share of frames whose worst joint is within it."""
    lost_rate: float
    """Share of frames whose mean joint error is over `LOST_THRESHOLD_MM`."""
    missing_rate: float
    """Share of frames in which at least one joint had no finite prediction."""

    def to_dict(self) -> dict[str, Any]:
        """Return the accuracy part of a benchmark case."""
        return {
            "frames": self.frames,
            "keypoint_error_mm": {
                "mean": self.mean_mm,
                "median": self.median_mm,
                "p95": self.p95_mm,
            },
            "success_rate": dict(self.success_rate),
            "lost_rate": self.lost_rate,
            "missing_rate": self.missing_rate,
        }


def keypoint_errors(predicted: ArrayLike, truth: ArrayLike) -> NDArray[np.float64]:
    """Euclidean distance of every joint from its true place.

    Args:
        predicted: Predicted positions [m], shape (n, njoint, 3); non-finite entries mean "no
            prediction".
        truth: True positions [m], same shape, finite.

    Returns:
        Errors [mm], shape (n, njoint), float64, finite: `MISSING_ERROR_MM` where there is no
        prediction.

    Raises:
        InputError: Shapes differ or are not (n, njoint, 3), or the truth is not finite.
    """
    predicted, truth = _positions(predicted, truth)
    with np.errstate(invalid="ignore", over="ignore"):
        errors = 1e3 * np.linalg.norm(predicted - truth, axis=-1)
    return np.where(np.isfinite(errors), errors, MISSING_ERROR_MM)


def missing_frames(predicted: ArrayLike) -> NDArray[np.bool_]:
    """Frames in which at least one coordinate of the prediction is not finite, shape (n,)."""
    array = np.asarray(predicted, dtype=np.float64)
    return np.any(~np.isfinite(array.reshape(len(array), -1)), axis=1)


def success_rate(
    errors_mm: ArrayLike, thresholds_mm: Sequence[float] = SUCCESS_THRESHOLDS_MM
) -> dict[str, float]:
    """Share of frames whose worst joint is within each threshold.

    Args:
        errors_mm: Errors [mm], shape (n, njoint).
        thresholds_mm: Distances [mm]; a frame exactly at the threshold succeeds.

    Returns:
        Threshold as text without trailing zeros ("20", "30", "2.5") -> share in [0, 1].
    """
    worst = _errors(errors_mm).max(axis=1)
    return {f"{t:g}": float(np.mean(worst <= t)) for t in thresholds_mm}


def success_curve(errors_mm: ArrayLike, thresholds_mm: ArrayLike) -> NDArray[np.float64]:
    """Share of frames whose worst joint is within each of many thresholds.

    Args:
        errors_mm: Errors [mm], shape (n, njoint).
        thresholds_mm: Distances [mm], shape (nthreshold,), any order.

    Returns:
        Shares in [0, 1], shape (nthreshold,), float64.
    """
    worst = np.sort(_errors(errors_mm).max(axis=1))
    within = np.searchsorted(worst, np.asarray(thresholds_mm, dtype=np.float64), side="right")
    return within / len(worst)


def lost_rate(errors_mm: ArrayLike, threshold_mm: float = LOST_THRESHOLD_MM) -> float:
    """Share of frames whose mean joint error is over the threshold [mm].

    Args:
        errors_mm: Errors [mm], shape (n, njoint).
        threshold_mm: Mean error [mm] above which a frame is lost.
    """
    return float(np.mean(_errors(errors_mm).mean(axis=1) > threshold_mm))


def summarize(predicted: ArrayLike, truth: ArrayLike) -> AccuracySummary:
    """Measure predicted positions against the truth.

    Args:
        predicted: Predicted positions [m], shape (n, njoint, 3); non-finite entries mean "no
            prediction".
        truth: True positions [m], same shape, finite.
    """
    return summarize_errors(
        keypoint_errors(predicted, truth), missing_rate=float(np.mean(missing_frames(predicted)))
    )


def summarize_errors(errors_mm: ArrayLike, *, missing_rate: float = 0.0) -> AccuracySummary:
    """Summarise errors that were measured before, for instance over several sequences.

    Args:
        errors_mm: Errors [mm], shape (n, njoint), finite.
        missing_rate: Share of frames without a complete prediction, taken over as it is.
    """
    errors = _errors(errors_mm)
    return AccuracySummary(
        frames=len(errors),
        mean_mm=float(errors.mean()),
        median_mm=float(np.median(errors)),
        p95_mm=float(np.percentile(errors, 95.0)),
        success_rate=success_rate(errors),
        lost_rate=lost_rate(errors),
        missing_rate=missing_rate,
    )


def phalanx_errors(
    predicted: ArrayLike, truth: ArrayLike, *, palm: bool = True
) -> NDArray[np.float64]:
    """Error of each rigid segment: the mean distance of its two end points from their true places.

    The 15 phalanges are those of the keypoint skeleton (the thumb's three segments and three of
    each finger); the palm, from the wrist to the middle finger's MCP joint, is the sixteenth. The
    error of a frame is the mean over the segments.

    Args:
        predicted: Predicted keypoints [m], shape (n, 21, 3).
        truth: True keypoints [m], same shape.
        palm: Count the palm segment too (the source measures all segments of its model).

    Returns:
        Errors [mm], shape (n, 16), or (n, 15) without the palm.

    Source:
        Hamer, PhD thesis, ETH Zurich, section 4.4.1; the same sequence is in Hamer et al.,
        "Tracking a hand manipulating an object", ICCV 2009.
    """
    errors = keypoint_errors(predicted, truth)
    if errors.shape[1] != 21:
        raise InputError(f"phalanx errors need 21 keypoints per frame, got {errors.shape[1]}")
    ends = np.array(SEGMENTS if palm else PHALANGES)
    return errors[:, ends].mean(axis=2)


def phalanx_summary(predicted: ArrayLike, truth: ArrayLike) -> dict[str, float]:
    """Summarise the frame errors over the segments [mm]: the benchmark's `phalanx_error_mm`.

    Args:
        predicted: Predicted keypoints [m], shape (n, 21, 3).
        truth: True keypoints [m], same shape.
    """
    frame_errors = phalanx_errors(predicted, truth).mean(axis=1)
    return {
        "mean": float(frame_errors.mean()),
        "median": float(np.median(frame_errors)),
        "max_frame": float(frame_errors.max()),
    }


def calibration(
    errors_mm: ArrayLike, deviations_mm: ArrayLike, visible: ArrayLike | None = None
) -> dict[str, dict[str, float]]:
    """How often the error is within one and two of the deviations that a tracker states.

    Keypoints without a stated deviation are left out, and so is everything about groups that have
    none. An error with the stated deviation that is Gaussian and alike in all directions is within
    one in 61 % and within two in 99 % of the cases; along one direction alone, in 68 % and 95 %.

    Args:
        errors_mm: Errors [mm], shape (n, njoint).
        deviations_mm: One sigma of each [mm], same shape; NaN where it is not known.
        visible: 1 for joints in sight, 0 for hidden ones, NaN where that is not known, same shape;
            None when it is not known of any.

    Returns:
        Group "all", "visible" or "hidden" -> "joints", their number, "within_1_sigma" and
        "within_2_sigma", shares in [0, 1], "median_sigma_mm" and "median_error_mm" [mm].

    Raises:
        InputError: Shapes differ.
    """
    errors, sigma = _errors(errors_mm), np.asarray(deviations_mm, np.float64)
    seen = np.full(errors.shape, np.nan) if visible is None else np.asarray(visible, np.float64)
    if not errors.shape == sigma.shape == seen.shape:
        raise InputError(
            f"errors, deviations and visibility have shapes {errors.shape}, {sigma.shape} and "
            f"{seen.shape}: they must be the same"
        )
    stated = np.isfinite(sigma)
    groups = {"all": stated, "visible": stated & (seen == 1), "hidden": stated & (seen == 0)}
    return {
        name: {
            "joints": int(group.sum()),
            "within_1_sigma": float(np.mean(errors[group] <= sigma[group])),
            "within_2_sigma": float(np.mean(errors[group] <= 2 * sigma[group])),
            "median_sigma_mm": float(np.median(sigma[group])),
            "median_error_mm": float(np.median(errors[group])),
        }
        for name, group in groups.items()
        if group.any()
    }


def _positions(predicted: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    """Both arrays in float64 after checking that they can be compared."""
    predicted = np.asarray(predicted, dtype=np.float64)
    truth = np.asarray(truth, dtype=np.float64)
    if predicted.shape != truth.shape or truth.ndim != 3 or truth.shape[-1] != 3 or not truth.size:
        raise InputError(
            f"predictions of shape {predicted.shape} cannot be compared with a truth of shape "
            f"{truth.shape}: both must be (n, njoint, 3) with at least one frame"
        )
    if not np.isfinite(truth).all():
        bad = int(np.count_nonzero(~np.isfinite(truth.reshape(len(truth), -1)).all(axis=1)))
        raise InputError(
            f"the truth is not finite in {bad} frames: leave those frames out on both sides"
        )
    return predicted, truth


def _errors(errors_mm: ArrayLike) -> NDArray[np.float64]:
    """Errors in float64 after checking their shape."""
    errors = np.asarray(errors_mm, dtype=np.float64)
    if errors.ndim != 2 or not errors.size:
        raise InputError(
            f"errors must have the shape (n, njoint) with at least one frame, got {errors.shape}"
        )
    return errors
