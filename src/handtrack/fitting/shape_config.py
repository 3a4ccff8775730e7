"""Settings of the fit of a hand's shape to several depth images (thesis II.3.6)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig


def _pose_fit() -> FitConfig:
    return replace(
        FitConfig(), iterations=4, robust_start=0.006, robust_scale=0.006, smooth_weight=0.1,
        # Sleeve and wrist bend as the model's stub of forearm does not: keep off them.
        wrist_cut=0.015,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFitConfig:
    """Settings of the alternation of Eq. II.11."""

    fit: FitConfig = field(default_factory=_pose_fit)
    """The fit of the poses between two steps of the shape; its terms are those of the shape too."""
    rounds: int = 40
    """Most rounds of poses and shape."""
    settled: float = 1e-4
    """The fit ends when no bone length changes by more in a round [m]."""
    follow_poses: bool = True
    """Let the poses answer to each step of the shape (Schur complement); without, the shape is
    solved with the poses held, as in the thesis, and takes many more rounds."""
    prior_weight: float = 0.1
    """Weight of a squared standard deviation of alpha and beta, against residuals per squared
    centimetre."""
    scale_deviation: float = 0.05
    """Deviation of log(scale) beside what alpha says of sizes."""
    pose_floor: float = 0.5
    """Added to the poses' diagonal in the Schur complement [1/rad^2, 1/cm^2 for translation]."""
    max_step: float = 1.0
    """Longest step of a standard deviation per round."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("fit", "follow_poses"):
                continue
            if not 0 < value < float("inf"):
                raise InputError(f"ShapeFitConfig.{item.name} is {value!r}; expected above 0")
