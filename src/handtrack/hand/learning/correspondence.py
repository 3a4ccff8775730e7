"""Which point of a scan belongs to which vertex of the posed template (C of Eq. II.10).

A vertex goes with the nearest scan point whose normal agrees, unless that point is too far, turned
away, or at the rim of a hole: where the scan ends, its last points would draw in whatever should
lie beyond. What is left out keeps its place by the smoothness of the offsets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from handtrack.hand.learning.scans import Scan

Float = NDArray[np.float64]

NORMAL_REACH = 0.012
"""Distance [m] that counts as much as a unit of difference between normals in the search: the
other side of a finger, and the finger beside it, then lie farther than its own skin."""


LARGEST_TURN = np.radians(60.0)
"""Largest angle between the normals of a match [rad]."""

_ASKING = 1000
"""Scan points that look for a vertex."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Matches:
    """Pairs of vertices of one posed template and points of its scan."""

    vertices: NDArray[np.intp]
    """Numbers of the vertices, shape (n,)."""
    targets: Float
    """Points that they should meet [m], shape (n, 3)."""
    normals: Float
    """Unit normals of the scan there, shape (n, 3)."""
    weights: Float
    """0 for no match at all, else at most 1: how far to trust it, shape (n,)."""
    exact: bool
    """Whether vertices belong at their targets, or only in the planes through them."""

    def away(self, vertices: Float) -> Float:
        """Vertices less their targets [m], shape (n, 3)."""
        return vertices[self.vertices] - self.targets

    def distances(self, vertices: Float) -> Float:
        """Distances that count [m] of the pairs that are matches: from planes, or from points."""
        away = self.away(vertices)[self.weights > 0]
        if self.exact:
            return np.linalg.norm(away, axis=1)
        return np.abs(np.einsum("vi,vi->v", away, self.normals[self.weights > 0]))

    def rows(self, jacobian: Float, vertices: Float) -> tuple[Float, Float]:
        """Weighted residuals and their derivatives, one row per equation.

        Args:
            jacobian: Derivative of the vertices, shape (nvert, 3, m).
            vertices: Vertices [m], shape (nvert, 3).

        Returns:
            Derivatives, shape (nrow, m), and residuals [m], shape (nrow,).
        """
        kept = np.flatnonzero(self.weights)
        scale = np.sqrt(self.weights[kept])
        away = self.away(vertices)[kept] * scale[:, None]
        moved = jacobian[self.vertices[kept]] * scale[:, None, None]
        if self.exact:
            return moved.reshape(-1, jacobian.shape[2]), away.ravel()
        normals = self.normals[kept]
        rows = (normals[:, None] @ moved)[:, 0]
        return rows, np.einsum("vi,vi->v", normals, away)

    def metric(self) -> Float:
        """Weighted projection whose quadratic form is the squared residual, shape (n, 3, 3)."""
        plain = np.broadcast_to(np.eye(3), (len(self.weights), 3, 3))
        along = self.normals[:, :, None] * self.normals[:, None, :]
        return self.weights[:, None, None] * (plain if self.exact else along)


class ScanSurface:
    """A scan made ready for searching."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self._tree = KDTree(described(scan.points, scan.normals))
        inside = np.flatnonzero(~scan.on_edge)
        rng = np.random.default_rng(len(inside))
        self._asking = rng.choice(inside, min(_ASKING, len(inside)), replace=False)

    def match(self, vertices: Float, normals: Float, *, reach: float) -> Matches:
        """The scan point of every vertex of the posed template.

        Args:
            vertices: Vertices [m], shape (nvert, 3).
            normals: Their unit normals, shape (nvert, 3).
            reach: Matches at this distance [m] count nothing any more (Tukey's biweight).

        Returns:
            One pair for each vertex, in order; in a registered scan, its own vertex.
        """
        scan, order = self.scan, np.arange(len(vertices))
        if scan.registered:
            return Matches(
                vertices=order,
                targets=scan.points,
                normals=scan.normals,
                weights=np.ones(len(vertices)),
                exact=True,
            )
        nearest = np.asarray(self._tree.query(described(vertices, normals))[1])
        return self._weighed(order, nearest, vertices, normals, ~scan.on_edge[nearest], reach)

    def match_back(
        self, vertices: Float, normals: Float, stub: NDArray[np.bool_], *, reach: float
    ) -> Matches:
        """A vertex for each of some scan points, so that no finger of the scan is left alone.

        Args:
            vertices: Vertices [m], shape (nvert, 3).
            normals: Their unit normals, shape (nvert, 3).
            stub: Vertices that take no scan point, for a scan may hold more of the arm, shape
                (nvert,).
            reach: Matches at this distance [m] count nothing any more.

        Returns:
            One pair for each asking point; none for a registered scan, whose matches are known.
        """
        if self.scan.registered:
            nobody = np.zeros(0, np.intp)
            return self._weighed(nobody, nobody, vertices, normals, np.zeros(0, bool), reach)
        asking = self._asking
        question = described(self.scan.points[asking], self.scan.normals[asking])
        nearest = np.asarray(KDTree(described(vertices, normals)).query(question)[1])
        return self._weighed(nearest, asking, vertices, normals, ~stub[nearest], reach)

    def _weighed(
        self,
        rows: NDArray[np.intp],
        points: NDArray[np.intp],
        vertices: Float,
        normals: Float,
        kept: NDArray[np.bool_],
        reach: float,
    ) -> Matches:
        """Pairs of vertices and points, weighed by distance, normals compared."""
        targets, facing = self.scan.points[points], self.scan.normals[points]
        agree = np.einsum("vi,vi->v", facing, normals[rows]) > np.cos(LARGEST_TURN)
        distance = ((vertices[rows] - targets) ** 2).sum(axis=1) / reach**2
        return Matches(
            vertices=rows,
            targets=targets,
            normals=facing,
            weights=np.where(kept & agree, np.clip(1.0 - distance, 0.0, None) ** 2, 0.0),
            exact=False,
        )


def described(points: Float, normals: Float) -> Float:
    """What is compared in a search, shape (n, 6)."""
    return np.hstack([points, NORMAL_REACH * normals])
