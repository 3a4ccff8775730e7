"""Skinning weights that suit the scans of all subjects, shapes and poses fixed.

Second half of the alternation of Eq. II.10. Weights stay what the rest of handtrack expects: not
negative, summing to one, the palm and one finger per vertex, at most three bones. With so few bones
the best weights of a vertex are found exactly, by trying every set of bones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from handtrack.hand.learning.subject import neighbour_laplacian
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]

SLOTS = 3
"""Bones per vertex, as `HandModel` stores them."""
_RINGS = 2
"""A bone may come to move vertices within so many edges of those that it moved at first."""
_SWEEPS = 40
"""Rounds in which neighbours settle with each other."""
_CHANGE = 1e-4
"""Largest change of a weight at which they are settled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightSupport:
    """Which bones may move which vertices."""

    bones: NDArray[np.intp]
    """The palm and the bones of the vertex's finger, shape (nvert, 4)."""
    allowed: NDArray[np.bool_]
    """Which of them may, shape (nvert, 4)."""
    first: Float
    """Weights at first, of all bones, shape (nvert, 16)."""

    @classmethod
    def of(cls, model: HandModel) -> WeightSupport:
        """Support around the weights of a model."""
        first = dense_weights(model.weight_bones, model.weights)
        count = len(first)
        beside = neighbour_laplacian(model.faces) != 0
        fingers = first[:, 1:].reshape(count, 5, 3).sum(axis=2)
        owned = np.flatnonzero(fingers.sum(axis=1) > 0)
        source = dijkstra(
            beside, indices=owned, unweighted=True, min_only=True, return_predecessors=True
        )[2]
        chain = fingers[source].argmax(axis=1)
        bones = np.hstack([np.zeros((count, 1), np.intp), 1 + 3 * chain[:, None] + np.arange(3)])
        near = first > 0
        for _ in range(_RINGS):
            near = (beside @ near.astype(float) + near) > 0
        allowed = np.take_along_axis(near, bones, axis=1)
        return cls(bones=bones, allowed=allowed, first=first)


def dense_weights(bones: NDArray, weights: Float) -> Float:
    """Weights of all bones, shape (nvert, 16), of weights in slots."""
    out = np.zeros((len(weights), NBONE))
    np.add.at(out, (np.arange(len(weights))[:, None], bones), weights)
    return out


def slot_weights(dense: Float) -> tuple[NDArray[np.int32], Float]:
    """Bones and weights in slots, largest first; unused slots are the palm with weight 0."""
    bones = np.argsort(-dense, axis=1, kind="stable")[:, :SLOTS]
    weights = np.take_along_axis(dense, bones, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.where(weights > 0, bones, 0).astype(np.int32), weights


def learn_weights(
    forms: Float, support: WeightSupport, weights: Float, faces: NDArray, spread: float
) -> Float:
    """Weights that bring the template's vertices nearest to their matches in all scans.

    Neighbouring vertices are asked to depart alike from the first weights, which leaves those
    unchanged where no scan says anything. The sum over edges is bounded by one term per vertex
    around the present weights; every sweep minimises that bound exactly, so the energy never rises.

    Args:
        forms: Quadratic forms of the support's weights, the sum of `SubjectFitter.weight_terms`
            over all subjects, shape (nvert, 4, 4).
        support: Which bones may move which vertices.
        weights: Present weights of all bones, shape (nvert, 16).
        faces: Triangles of the template, shape (nface, 3).
        spread: Standard deviation of the difference between neighbours.

    Returns:
        Weights of all bones, shape (nvert, 16).
    """
    laplacian = neighbour_laplacian(faces)
    degree = np.asarray(laplacian.diagonal(), np.float64)
    forms = forms + (2.0 * degree / spread**2)[:, None, None] * np.eye(support.bones.shape[1])
    change = weights - support.first
    for _ in range(_SWEEPS):
        # 2 sum_j |x_i - (x_i0 + x_j0) / 2|^2 bounds sum_j |x_i - x_j|^2.
        apart = np.asarray(laplacian @ change)
        wanted = support.first + change - 0.5 * apart / degree[:, None]
        pull = np.take_along_axis(wanted, support.bones, axis=1)
        pull *= (2.0 * degree / spread**2)[:, None]
        settled = np.zeros_like(weights)
        best = _best_on_simplex(forms, pull, support.allowed)
        np.put_along_axis(settled, support.bones, best, axis=1)
        moved = np.abs(settled - support.first - change).max()
        change = settled - support.first
        if moved < _CHANGE:
            break
    return support.first + change


def _best_on_simplex(forms: Float, pull: Float, allowed: NDArray[np.bool_]) -> Float:
    """Minimisers of w F w - 2 p w with w >= 0, sum w = 1 and at most three nonzero entries."""
    count, size = pull.shape
    best, lowest = np.zeros((count, size)), np.full(count, np.inf)
    for number in range(1, SLOTS + 1):
        for chosen in combinations(range(size), number):
            columns = list(chosen)
            rows = np.flatnonzero(allowed[:, columns].all(axis=1))
            system = np.zeros((len(rows), number + 1, number + 1))
            system[:, :number, :number] = forms[rows][:, columns][:, :, columns]
            system[:, :number, number] = system[:, number, :number] = 1.0
            right = np.ones((len(rows), number + 1))
            right[:, :number] = pull[rows][:, columns]
            found = np.linalg.solve(system, right[..., None])[:, :number, 0]
            curved = np.einsum("vi,vij,vj->v", found, system[:, :number, :number], found)
            value = curved - 2.0 * (found * right[:, :number]).sum(axis=1)
            better = (found >= 0).all(axis=1) & (value < lowest[rows])
            lowest[rows[better]] = value[better]
            best[rows[better]] = 0.0
            best[rows[better, None], chosen] = found[better]
    return best


def mean_weight_error(weights: Float, truth: Float) -> float:
    """Mean over vertices of the summed absolute differences of two sets of weights."""
    return float(np.abs(weights - truth).sum(axis=1).mean())
