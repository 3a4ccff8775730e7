"""Settings of learning from scans."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from handtrack.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningOptions:
    """How a hand model is learnt; standard deviations weigh the terms of the energy."""

    rounds: int = 6
    """Alternations between the subjects and the weights that all of them share."""
    first_steps: int = 16
    """Steps for bones and poses of a new subject, before its offsets move."""
    steps: int = 4
    """Further steps of a subject in every round, each for bones, poses and offsets."""
    learn_weights: bool = True
    """Whether the skinning weights are learnt too."""
    share: float = 0.98
    """Share of the variance that the components of each basis have to explain."""
    max_points: int = 20_000
    """Points kept of a scan: bounds memory and time."""

    data_std: float = 0.0003
    """Distance of a vertex from its match [m]. Larger than a scanner's noise, since neighbouring
    vertices are not independent."""
    exact_std: float = 0.0001
    """The same for registered scans [m], whose matches are known."""
    reach: tuple[float, float] = (0.03, 0.006)
    """Largest distance of a match [m], for the first step and from the first round on."""
    bend_std: float = 0.0004
    """Difference between the offsets of neighbouring vertices [m]."""
    offset_std: float = 0.004
    """Offset of a vertex from the mean of all subjects [m]."""
    joint_std: float = 0.002
    """Offset of a base joint from the mean of all subjects [m]."""
    scale_std: float = 0.05
    """Scale s_j of a bone against the mean of all subjects."""
    angle_std: float = 0.35
    """How far from the asked pose people bend a joint [rad]."""
    limit_std: float = 0.03
    """Angle beyond a joint limit [rad]."""
    weight_std: float = 0.05
    """Difference between what neighbouring vertices' weights change by."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A number is out of range.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_std") and not (np.isfinite(value) and value > 0):
                raise InputError(f"{field.name} is {value}; expected a positive number")
        if self.rounds < 1 or self.first_steps < 1 or self.steps < 1 or self.max_points < 500:
            raise InputError(
                "expected at least one round and one step, and 500 points or more of each scan"
            )
        if not 0 < self.share <= 1:
            raise InputError(f"share is {self.share}; expected a share of variance within 0 to 1")
        if not 0 < self.reach[1] <= self.reach[0]:
            raise InputError(f"reach is {self.reach}; expected a falling pair of distances")
