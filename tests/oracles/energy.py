"""Energy terms of Eq. II.21 and beyond as functions of the pose, and derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.model import ShapedHand
from handtrack.transforms import apply_increment, pose_difference

Float = NDArray[np.float64]

STEP = 1e-5
"""Step of central differences [m, rad]: error of second order, far above float64 rounding."""

NV = 27


def differences(function: Callable[[Float], Float], pose: Float, step: float = STEP) -> Float:
    """Central differences on the manifold, shape (..., 27) of a function of one pose."""
    columns = []
    for unknown in range(NV):
        move = np.zeros(NV)
        move[unknown] = step
        ahead, behind = (
            function(apply_increment(pose, move)),
            function(apply_increment(pose, -move)),
        )
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, -1)


def vertex_jacobian(hand: ShapedHand, pose: Float) -> Float:
    """d vertices / d increment by central differences on float64 skinning, shape (nvert, 3, 27)."""
    return differences(lambda q: skin(hand, q), pose)


def geman_mcclure(squared: Float, scale: float) -> Float:
    """Robust cost of a squared distance: s^2 r^2 / (s^2 + r^2)."""
    return scale**2 * squared / (scale**2 + squared)


def geman_mcclure_weight(squared: Float, scale: float) -> Float:
    """Its derivative by r^2, the weight of the reweighted least squares."""
    return (scale**2 / (scale**2 + squared)) ** 2


def smoothness(pose: Float, reference: Float, weights: Float) -> float:
    """Eq. II.24 with one weight per unknown, on the manifold."""
    return float(weights @ pose_difference(pose, reference) ** 2)


def limits(angles: Float, bounds: Float, weight: float) -> float:
    """Eq. II.25: squared excess over the joint limits."""
    low, high = bounds.T
    over = np.where(angles < low, angles - low, 0.0) + np.where(angles > high, angles - high, 0.0)
    return float(weight * (over**2).sum())


def gaussian(angles: Float, mean: Float, precision: Float, weight: float) -> float:
    """Squared Mahalanobis distance of the angles."""
    return float(weight * (angles - mean) @ precision @ (angles - mean))


class Spheres:
    """Spheres on bones whose pairs should not overlap."""

    def __init__(
        self, hand: ShapedHand, bones: NDArray, centres: Float, radii: Float, pairs: NDArray
    ) -> None:
        self.hand, self.bones, self.local, self.radii = hand, bones, centres, radii
        self.first, self.second = pairs.T

    def distances(self, pose: Float) -> Float:
        """Distances between the centres of all pairs [m]."""
        rotations, origins = bone_frames(self.hand, pose)
        centres = (rotations[self.bones] @ self.local[..., None])[..., 0] + origins[self.bones]
        return np.linalg.norm(centres[self.first] - centres[self.second], axis=1)

    def overlaps(self, pose: Float) -> Float:
        """How deep the two spheres of each pair reach into each other [m], 0 when apart."""
        reach = self.radii[self.first] + self.radii[self.second]
        return np.maximum(reach - self.distances(pose), 0.0)

    def energy(self, pose: Float, weight: float) -> float:
        """Weighted sum of squared overlaps."""
        return float(weight * (self.overlaps(pose) ** 2).sum())


def dense_rows(rows: Float, chains: NDArray) -> Float:
    """Compact Jacobian rows as rows of all 27 unknowns; negative chains give zeros."""
    dense = np.zeros((len(rows), NV))
    firsts = np.array([6, 11, 15, 19, 23, 27])
    for row, chain, out in zip(rows, chains, dense, strict=True):
        if chain < 0:
            continue
        first, last = firsts[chain], firsts[chain + 1]
        out[:6] = row[:6]
        out[first:last] = row[6 : 6 + last - first]
        # The thumb has five angles, a finger four: the eleventh number must then be nothing.
        assert (row[6 + last - first :] == 0).all()
    return dense
