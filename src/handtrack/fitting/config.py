"""Settings of the fit of one frame: sampling, terms and Gauss-Newton (thesis II.5.2)."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass, fields

import numpy as np

from handtrack.errors import InputError

_SIGNED = ("min_cosine", "wrist_cut")
_POSITIVE = (
    "crop_cells", "crop_span", "gate_radius", "point_stride", "bin_cells", "max_distance",
    "robust_scale", "robust_start", "silhouette_scale", "front_scale", "max_translation",
    "max_rotation", "max_angle", "score_scale", "score_cap",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """One frame's fit. Weights are per squared centimetre and per squared radian.

    The thesis gives its weights without the unit of length; in centimetres its three terms balance.
    """

    crop_cells: int = 128
    """Cells along one side of the crop."""
    crop_span: float = 0.27
    """Width of the crop at the hand's distance [m]; a small camera's crop may be wider."""
    gate_radius: float = 0.17
    """Radius of the sphere around the expected hand that depth must lie in [m]."""
    same_surface: float = 0.015
    """Neighbouring pixels closer in depth than this share a surface [m]."""
    point_stride: int = 2
    """Every n-th cell in both directions is a point of the data term."""
    bin_cells: int = 4
    """Side of a search bin [cells]."""
    search_window: int = 2
    """Bins searched on each side of a point's own (II.5.2.1's window)."""
    max_distance: float = 0.04
    """Longest correspondence [m]."""
    normal_reach: int = 2
    """Neighbours used for observed normals [cells]; 0 leaves normals out of the matching."""
    min_cosine: float = 0.3
    """Least cosine between observed and model normal for a match; -1 accepts all."""
    wrist_cut: float = 0.0
    """Palm-frame x below which observed points are the forearm's [m]; 0 is the wrist joint."""

    iterations: int = 10
    """Gauss-Newton steps per frame."""
    point_weight: float = 1.0
    """lambda_1 of Eq. II.21: weight of the registration term [1/cm^2]."""
    tangent_weight: float = 0.0
    """Share of the tangential distance: 0 is point-to-plane, 1 point-to-point (Eq. II.23)."""
    robust_scale: float = 0.008
    """Scale of the Geman-McClure weight of the registration term [m]; large switches it off."""
    robust_start: float = 0.02
    """That scale in the first iteration; it shrinks geometrically to `robust_scale` in the last
    [m]."""
    smooth_weight: float = 2.0
    """lambda_2 of Eq. II.21: smoothness of translation [1/cm^2] and rotations [1/rad^2]. The thesis
    has 0.2; more filters sensor noise, and lags behind fast motion."""
    limit_weight: float = 1000.0
    """lambda_3 of Eq. II.21: weight of squared excess over a joint limit [1/rad^2]."""

    palm_only: bool = False
    """Move the palm alone: points matched to fingers do not count, and angles stay (II.5.1, step
    1)."""

    silhouette_weight: float = 0.3
    """Weight of model vertices over the background [1/cm^2]; 0 switches the term off."""
    silhouette_scale: float = 0.03
    """Geman-McClure scale of that distance [m]."""
    silhouette_margin: float = 0.005
    """Distance outside the silhouette that costs nothing [m]; sensors gnaw at edges."""
    silhouette_reach: int = 24
    """Farthest foreground looked for [cells]."""
    front_weight: float = 0.0
    """Weight of model vertices in front of the observed surface [1/cm^2]; 0 switches the term
    off."""
    front_scale: float = 0.03
    """Geman-McClure scale of that distance [m]."""
    front_margin: float = 0.015
    """Distance in front of the surface that costs nothing [m]."""
    collision_weight: float = 2.0
    """Weight of overlaps between fingers [1/cm^2]; 0 switches the term off."""
    prior_weight: float = 0.0
    """Weight of the Gaussian prior on joint angles, 1 = its own covariance; 0 switches it off."""

    levenberg: bool = False
    """Accept a step only when the energy falls, and adapt the damping (Levenberg)."""
    damping: float = 0.01
    """Relative damping of the normal equations; with `levenberg` its first value."""
    translation_floor: float = 0.01
    """Constant added to the diagonal for translation [1/cm^2]."""
    angle_floor: float = 0.5
    """Constant added to the diagonal for rotation and joint angles [1/rad^2]."""
    max_translation: float = 0.05
    """Longest step of the palm per iteration and axis [m]."""
    max_rotation: float = 0.4
    """Largest turn of the palm per iteration and axis [rad]."""
    max_angle: float = 0.5
    """Largest change of a joint angle per iteration [rad]."""

    score_scale: int = 2
    """Cells per pixel of the rendered image that E_d compares, along each side."""
    score_cap: float = 0.04
    """Largest depth difference counted for one pixel of E_d [m]."""

    def robust_scales(self) -> list[float]:
        """Scale of the registration term's robust weight in each iteration [m]."""
        if self.levenberg:
            # Energies of different scales do not compare.
            return [self.robust_scale] * self.iterations
        return np.geomspace(self.robust_start, self.robust_scale, self.iterations).tolist()

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            number = float(value) if isinstance(value, numbers.Real) else math.nan
            counted = isinstance(field.default, int)
            kind = "whole" if counted else "finite"
            if not (
                math.isfinite(number)
                and (isinstance(value, numbers.Integral) or not counted)
                and (number >= 0 or field.name in _SIGNED)
                and (number > 0 or field.name not in _POSITIVE)
            ):
                least = (
                    "" if field.name in _SIGNED else " > 0" if field.name in _POSITIVE else " >= 0"
                )
                raise InputError(
                    f"FitConfig.{field.name} is {value!r}; expected a {kind} number{least}"
                )
        divisor = np.lcm(self.bin_cells, np.lcm(self.point_stride, self.score_scale))
        if self.crop_cells < 16 or self.crop_cells % divisor:
            raise InputError(
                f"FitConfig.crop_cells is {self.crop_cells}; expected at least 16 and a multiple of"
                f" {divisor} (bin_cells, point_stride and score_scale)"
            )


THESIS = FitConfig(
    tangent_weight=1.0,
    robust_scale=10.0,
    robust_start=10.0,
    normal_reach=0,
    min_cosine=-1.0,
    silhouette_weight=0.0,
    front_weight=0.0,
    collision_weight=0.0,
    damping=0.0,
    translation_floor=1e-6,
    angle_floor=1e-6,
    smooth_weight=0.2,
    iterations=4,
)
"""The energy of Eq. II.21 with the thesis' weights: point-to-point, smoothness, limits, plain
steps."""
