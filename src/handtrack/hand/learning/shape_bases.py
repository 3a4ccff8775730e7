"""PCA of what was found of all subjects: S0, C_S, Q0, C_Q of Eq. II.4 and II.6."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.learning.posed_template import SubjectShape, Template
from handtrack.hand.model import HandModel

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeBases:
    """Mean and basis of scales and offsets; coordinates have unit variance over the subjects."""

    scale_mean: Float
    """Shape (17,)."""
    scale_basis: Float
    """Shape (17, nalpha)."""
    scale_variance: Float
    """Share of the variance that each column explains, shape (nalpha,)."""
    offset_mean: Float
    """Vertices, then the five base joints [m], shape (nvert + 5, 3)."""
    offset_basis: Float
    """Shape (nvert + 5, 3, nbeta)."""
    offset_variance: Float
    """Share of the variance that each column explains, shape (nbeta,)."""

    def model(self, template: Template) -> HandModel:
        """The hand model with the template's weights and these bases."""
        return replace(
            template.model,
            scale_mean=self.scale_mean,
            scale_basis=self.scale_basis,
            offset_mean=self.offset_mean,
            offset_basis=self.offset_basis,
        )


def learn_bases(template: Template, shapes: Sequence[SubjectShape], share: float) -> ShapeBases:
    """PCA over subjects.

    Entries of S are compared in metres: a bone's scale counts by the bone's length, the overall
    scale by the root mean square distance of the vertices from the wrist.

    Args:
        template: The template.
        shapes: Shapes of at least two subjects.
        share: Share of the variance that the components have to explain.

    Raises:
        InputError: There are fewer than two subjects.
    """
    if len(shapes) < 2:
        raise InputError(f"a shape space of {len(shapes)} subject: expected two subjects or more")
    reach = np.sqrt((template.model.vertices**2).sum(axis=1).mean())
    units = np.concatenate([[reach], template.lengths])
    scales = principal_components(np.array([template.scales(s) for s in shapes]), units, share)
    stacked = np.array([shape.all_offsets.ravel() for shape in shapes])
    offsets = principal_components(stacked, np.ones(stacked.shape[1]), share)
    rows = len(template.model.vertices) + 5
    return ShapeBases(
        scale_mean=scales[0],
        scale_basis=scales[1],
        scale_variance=scales[2],
        offset_mean=offsets[0].reshape(rows, 3),
        offset_basis=offsets[1].reshape(rows, 3, -1),
        offset_variance=offsets[2],
    )


def principal_components(samples: Float, units: Float, share: float) -> tuple[Float, Float, Float]:
    """PCA with as many components as explain a share of the variance.

    Args:
        samples: Shape (n, d).
        units: Unit in which each entry is compared, shape (d,).
        share: Share of the total variance to explain.

    Returns:
        Mean, shape (d,); basis with one column per standard deviation, shape (d, ncomponent); share
        of the variance that each column explains, shape (ncomponent,).
    """
    mean = samples.mean(axis=0)
    _, deviations, components = np.linalg.svd((samples - mean) * units, full_matrices=False)
    explained = deviations**2 / (deviations**2).sum()
    count = min(int(np.searchsorted(np.cumsum(explained), share) + 1), len(samples) - 1)
    deviations = deviations[:count, None] / np.sqrt(len(samples) - 1)
    basis = (components[:count] * deviations / units).T
    # A component's sign is arbitrary: make its largest entry positive so that runs agree.
    signs = np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(count)])
    return mean, basis * signs, explained[:count]
