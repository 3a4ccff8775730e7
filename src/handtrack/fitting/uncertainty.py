"""How far the keypoints of a fitted pose may be off, from the fit's own normal equations.

Were the residuals independent, of variance s^2, and the model exact, then the increment would have
the covariance s^2 H^-1. Neither holds, so three things differ here:

* **Residual scale.** The robust residuals tell mostly the sensor's grain. What a wrong shape or a
  confused finger leaves is a rim that only one of model and image covers, and E_d counts that. With
  u = E_d / cap, the unexplained share of the area A seen, s = u^2 A / `OUTLINE`. E_d itself would
  not do: an outline costs a small or distant hand a larger share.
* **Correlation.** Neighbouring points err alike. A point counts as much as its share of a square
  of `CORRELATION_LENGTH`, and an error of s is common to all of them and stays.
* **Proportions.** A hand whose shape nobody told is fitted with bones of wrong lengths, which the
  image hides: a keypoint is uncertain by a share, `PROPORTIONS`, of its distance from the palm.
* **Hidden joints.** Smoothness holds an unseen finger still, but does not see it: it is left out.
  What nothing was seen of is uncertain by its range: that of its limits for a joint angle.

The constants were fitted by `models/fit_uncertainty.py` on `leap_hand_motion`, worn by eight drawn
subjects (seeds 200 to 207) at three distances, with the noise of three sensors, each tracked by the
hybrid tracker with its own and with the mean shape. They are round numbers near the least sum of
the quantile losses of log(error / sigma) for 65 % within one sigma and 95 % within two. What they
reach on other motion and subjects is told by `handtrack bench tracking`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.inverse_kinematics import BonePoints, point_jacobian
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand

Float = NDArray[np.float64]

OUTLINE = 0.095
"""Length that turns the squared unexplained share of the area seen into a residual scale [m]."""

CORRELATION_LENGTH = 0.0078
"""Side of the patch of surface whose points count as one [m]."""

PROPORTIONS = 0.045
"""Uncertainty of bone lengths where the shape is not known, as a share of them."""

FLOOR = 0.0008
"""Error of a keypoint that no image tells [m]: points are matched to vertices, not surfaces."""

PALM_RANGE = (0.1, 1.0)
"""Uncertainty of the palm's place [m] and rotation [rad] per axis when nothing was seen."""

_REST = np.array([0.0, 0.0, 0.0, 1.0] + [0.0] * 24)
"""All angles 0."""

_UNIFORM = 12**-0.5
"""Standard deviation of a uniform distribution, in units of its width."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitInformation:
    """What one row's last Gauss-Newton step knew of its pose: `Fitter.information`."""

    hessian: Float
    """Undamped Gauss-Newton matrix without smoothness: data, limits, prior, collisions; a point
    weighs 1/m^2, shape (27, 27)."""
    unexplained: float
    """Depth error E_d (Eq. II.19) in units of its cap: 0 is a perfect fit, 1 is nothing alike."""
    area: float
    """Area of hand and model that the camera sees, across the view [m^2]."""
    spacing: float
    """Distance of neighbouring points of the data term, across the view [m]."""
    shape_known: bool = True
    """Whether the hand that was fitted is the person's own."""

    @property
    def residual_scale(self) -> float:
        """One sigma of a residual [m]."""
        return self.unexplained**2 * self.area / OUTLINE

    @property
    def point_precision(self) -> float:
        """What a point tells, correlation with its neighbours considered [1/m^2]."""
        share = min((self.spacing / CORRELATION_LENGTH) ** 2, 1.0)
        return share / max(self.residual_scale, FLOOR) ** 2


def keypoint_deviation(hand: ShapedHand, pose: ArrayLike, information: FitInformation) -> Float:
    """One sigma of each keypoint, to compare with its distance from the truth.

    It is the root of the trace of the keypoint's 3x3 covariance J C J^T: the root mean square of
    the distance. Of a Gaussian error that is alike in all directions 61 % lie within one sigma and
    99 % within two; of one along a single direction 68 % and 95 %. Fingers that were taken for one
    another are not Gaussian, and miss.

    Args:
        hand: The hand that was fitted.
        pose: Its fitted pose, shape (28,).
        information: What the fit knew.

    Returns:
        Standard deviations [m], shape (21,); NaN when the fit knew nothing finite.
    """
    scale = information.residual_scale
    spread = np.concatenate(
        [np.repeat(PALM_RANGE, 3), _UNIFORM * (hand.limits[:, 1] - hand.limits[:, 0])]
    )
    precision = information.point_precision * information.hessian + np.diag(spread**-2.0)
    _, jacobian = point_jacobian(
        hand, BonePoints.of_keypoints(hand), np.asarray(pose, np.float64)[None]
    )
    if not np.isfinite(precision).all():
        return np.full(jacobian.shape[1], np.nan)
    covariance = np.linalg.inv(precision)
    variances = np.einsum("kai,ij,kaj->k", jacobian[0], covariance, jacobian[0])
    if not information.shape_known:
        rest = keypoints(hand, _REST)
        variances += (PROPORTIONS * np.linalg.norm(rest - palm_centre(rest), axis=1)) ** 2
    # Rounding must not make a variance negative.
    return np.sqrt(np.maximum(variances, 0.0) + scale**2 + FLOOR**2)
