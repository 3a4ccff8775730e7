"""How sure a fitted shape is, and what the images left open.

A residual counts as in `handtrack.fitting.uncertainty`, the prior with its own weight. Flesh and
size are strange numbers to judge by; what is judged are the lengths of the fingers' bones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.fitting.fitter import SQUARE_METRE
from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.skeleton import ANGLES, FINGERS

Float = NDArray[np.float64]

MODEL_ERROR = 0.0006
"""Error of a bone's length that the shape space itself leaves [m]."""

OPEN_SHARE = 0.6
"""A finger whose bones are known no better than this share of what is known without images is
open."""

STRETCHED = np.radians(60.0)
"""A finger whose middle joint is bent less than this shows its length [rad]."""

_MIDDLE_JOINTS = [
    ANGLES.index("thumb_ip_flexion"), *(ANGLES.index(f"{f}_pip_flexion") for f in FINGERS[1:])
]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeCertainty:
    """What is known of a shape."""

    deviations: Float
    """One sigma of log(scale), alpha, beta; shape (nshape,)."""
    lengths: Float
    """One sigma of each bone's length [m], shape (16,)."""
    prior_lengths: Float
    """The same without any image [m], shape (16,)."""

    bends: Float
    """Least flexion of each finger's middle joint in any image [rad], infinite without image; the
    thumb's end joint; shape (5,)."""

    @property
    def open_fingers(self) -> list[str]:
        """Fingers whose bones the images did not determine.

        The equations alone would not tell: taken at their word, the few surfaces of a fist fix its
        bones. But a finger that was never stretched hides where its bones end.
        """
        share = (self.lengths / self.prior_lengths)[1:].reshape(len(FINGERS), 3).max(axis=1)
        bent = self.bends > STRETCHED
        return [FINGERS[k] for k in np.flatnonzero((share > OPEN_SHARE) | bent)]

    @property
    def problem(self) -> str | None:
        """What the images did not determine; None when they did."""
        found = self.open_fingers
        if not found:
            return None
        told = "any finger" if len(found) == len(FINGERS) else ", ".join(found)
        return (
            f"the images do not determine the bones of {told}: add images in which they are seen "
            "straight and bent, not hidden in a fist"
        )


def image_precisions(information: Float, fits: Sequence[FitInformation]) -> Float:
    """What each image tells of the shape: inverse covariances, shape (n, nshape, nshape).

    Args:
        information: The same in the fit's weights, shape (n, nshape, nshape).
        fits: What the fit of each image's pose knew.
    """
    weights = np.array([fit.point_precision for fit in fits]) / SQUARE_METRE
    return weights[:, None, None] * information


def shape_certainty(
    unknowns: ShapeUnknowns,
    x: Float,
    information: Float,
    poses: Float,
    fits: Sequence[FitInformation],
    *,
    scale_deviation: float,
) -> ShapeCertainty:
    """How sure a shape is.

    Args:
        unknowns: The unknowns.
        x: Their values, shape (nshape,).
        information: What each image tells in the fit's weights, shape (n, nshape, nshape).
        poses: Pose in each image, shape (n, 28).
        fits: What the fit of each image's pose knew.
        scale_deviation: Deviation of log(scale) that is assumed without images.
    """
    deviations = np.ones(unknowns.count)
    deviations[0] = scale_deviation
    precision = image_precisions(information, fits).sum(axis=0) + np.diag(deviations**-2.0)
    covariance = np.linalg.inv(0.5 * (precision + precision.T))
    steps = unknowns.length_steps(x)
    bends = np.full(len(FINGERS), np.inf)
    if len(poses):
        bends = poses[:, 7:][:, _MIDDLE_JOINTS].min(axis=0)

    def lengths(matrix: Float) -> Float:
        return np.sqrt(np.maximum(np.einsum("bi,ij,bj->b", steps, matrix, steps), 0.0))

    return ShapeCertainty(
        deviations=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        lengths=np.hypot(lengths(covariance), MODEL_ERROR),
        bends=bends,
        prior_lengths=np.hypot(lengths(np.diag(deviations**2)), MODEL_ERROR),
    )
