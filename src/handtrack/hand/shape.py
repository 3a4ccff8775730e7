"""Shape of one person's hand: coordinates in the learnt shape space (thesis II.3.2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE

FORMAT_VERSION = 1

_TOLD = ("alpha_std", "beta_std", "scale_std", "problem")
"""What only fitted shapes tell."""


def _empty() -> NDArray[np.float64]:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, kw_only=True)
class HandShape:
    """Bone scales, vertex offsets and overall scale of one hand; the default is the mean hand.

    Shorter vectors than the model's are padded with zeros, so a shape survives a richer model.
    """

    alpha: NDArray[np.float64] = field(default_factory=_empty)
    """Coordinates of the bone scales, standard normal over the population, shape (<= nalpha,)."""
    beta: NDArray[np.float64] = field(default_factory=_empty)
    """Coordinates of the vertex offsets, standard normal over the population, shape (<= nbeta,)."""
    scale: float = 1.0
    """Overall factor on top of the model's own s_g(alpha)."""
    alpha_std: NDArray[np.float64] | None = None
    """One sigma of each entry of `alpha` where the shape was fitted, same shape."""
    beta_std: NDArray[np.float64] | None = None
    """One sigma of each entry of `beta`, same shape."""
    scale_std: float | None = None
    """One sigma of `scale`."""
    problem: str | None = None
    """What the images that it was fitted to did not determine; None when they did."""

    def __post_init__(self) -> None:
        for name in ("alpha", "beta"):
            value = np.asarray(getattr(self, name), np.float64)
            if value.ndim != 1 or not np.isfinite(value).all():
                raise InputError(
                    f"HandShape.{name} has shape {value.shape}; expected a vector of finite numbers"
                )
            object.__setattr__(self, name, value)
            self._check_deviations(f"{name}_std", len(value))
        if self.scale_std is not None and not 0.0 <= self.scale_std < np.inf:
            raise InputError(f"HandShape.scale_std is {self.scale_std}; expected at least 0")
        if not (np.isfinite(self.scale) and 0.2 <= self.scale <= 5.0):
            raise InputError(f"HandShape.scale is {self.scale}; expected a factor within 0.2 to 5")

    def _check_deviations(self, name: str, size: int) -> None:
        given = getattr(self, name)
        if given is None:
            return
        value = np.asarray(given, np.float64)
        if value.shape != (size,) or not ((value >= 0.0) & np.isfinite(value)).all():
            raise InputError(
                f"HandShape.{name} has shape {value.shape}; expected {size} numbers of at least 0"
            )
        object.__setattr__(self, name, value)

    def save(self, path: str | Path) -> None:
        """Write the shape to an .npz file."""
        entries: dict[str, object] = {
            "format_version": FORMAT_VERSION,
            "alpha": self.alpha,
            "beta": self.beta,
            "scale": self.scale,
        }
        for name in _TOLD:
            if getattr(self, name) is not None:
                entries[name] = getattr(self, name)
        # Given a name, NumPy would add ".npz" to it.
        with Path(path).open("wb") as file:
            np.savez(file, **entries)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> HandShape:
        """Read a shape written by `save`.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is not a hand shape.
        """
        if not Path(path).is_file():
            raise MissingFileError(f"no hand shape at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                version = int(data["format_version"])
                if version != FORMAT_VERSION:
                    raise ValueError(f"format {version}; this version reads {FORMAT_VERSION}")
                told: dict[str, Any] = {
                    name: data[name] if name.endswith("a_std") else data[name].item()
                    for name in _TOLD
                    if name in data.files
                }
                return cls(
                    alpha=data["alpha"], beta=data["beta"], scale=float(data["scale"]), **told
                )
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is not a hand shape file: {error}") from error
