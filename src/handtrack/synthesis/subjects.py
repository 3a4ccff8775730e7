"""Subjects that the hand model has not seen, exactly as they are: `data/subjects.npz`.

They come from the generator of the model's population with another seed (models/README.md), and
keep what the shape space cannot express of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError
from handtrack.files import UNREADABLE
from handtrack.hand.model import HandModel, ShapedHand

SUBJECTS_FILE = "data/subjects.npz"
"""The subjects that come with handtrack."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnseenSubjects:
    """Bone scales and vertex offsets of subjects (Eq. II.4, II.6)."""

    scales: NDArray[np.float64]
    """Overall scale, then one scale per bone, shape (n, 17)."""
    offsets: NDArray[np.float64]
    """Of the vertices and the five base joints [m], shape (n, nvert + 5, 3)."""

    def __len__(self) -> int:
        return len(self.scales)

    @classmethod
    def load(cls, path: str | Path | None = None) -> UnseenSubjects:
        """Read subjects; without a path, those that come with handtrack.

        Raises:
            DamagedFileError: The file holds no subjects.
        """
        path = Path(path) if path is not None else artifact_path(SUBJECTS_FILE)
        try:
            with np.load(path, allow_pickle=False) as data:
                scales = data["scales"].astype(np.float64)
                offsets = data["offsets"].astype(np.float64)
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} holds no subjects: {error}") from error
        return cls(scales=scales, offsets=offsets)

    def hand(self, number: int, model: HandModel, *, side: str = "right") -> ShapedHand:
        """Hand of a subject.

        Args:
            number: Which one.
            model: The model whose template the offsets belong to.
            side: "right" or "left".

        Raises:
            InputError: There is no such subject, or the offsets are of another template.
        """
        if not 0 <= number < len(self):
            raise InputError(f"subject {number} of {len(self)}: expected 0 to {len(self) - 1}")
        if self.offsets.shape[1:] != model.offset_mean.shape:
            raise InputError(
                f"offsets of subjects have shape {self.offsets.shape[1:]}; this model has "
                f"{model.offset_mean.shape}: draw them again as models/README.md says"
            )
        exact = replace(model, scale_mean=self.scales[number], offset_mean=self.offsets[number])
        return exact.shaped(side=side)
