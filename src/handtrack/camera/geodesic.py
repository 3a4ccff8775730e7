"""Distances along the surface that a depth image shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra


class SurfaceGraph:
    """The pixels of one connected surface, joined to their eight neighbours."""

    def __init__(self, points: NDArray[np.float32], mask: NDArray[np.bool_]) -> None:
        """Join the pixels of a surface.

        Args:
            points: Points [m], shape (height, width, 3), camera frame.
            mask: Pixels of the surface, shape (height, width).
        """
        self.rows, self.columns = np.nonzero(mask)
        """Pixel of each node, shape (node_count,) each."""
        self.points = points[mask].astype(np.float64)
        """Point of each node [m], shape (node_count, 3), camera frame."""
        self.node_count = len(self.rows)
        """Number of pixels."""
        number = np.full(mask.shape, -1)
        number[mask] = np.arange(self.node_count)
        ends = []
        for a, b in (
            (number[:, :-1], number[:, 1:]),
            (number[:-1], number[1:]),
            (number[:-1, :-1], number[1:, 1:]),
            (number[:-1, 1:], number[1:, :-1]),
        ):
            both = (a >= 0) & (b >= 0)
            ends.append(np.stack([a[both], b[both]], axis=1))
        self._straight_count = len(ends[0]) + len(ends[1])
        self._edges = np.concatenate(ends)
        lengths = np.linalg.norm(
            self.points[self._edges[:, 0]] - self.points[self._edges[:, 1]], axis=1
        )
        shape = (self.node_count, self.node_count)
        self._graph = coo_matrix((lengths, (self._edges[:, 0], self._edges[:, 1])), shape).tocsr()

    def central_node(self) -> int:
        """The node nearest to the mean of all."""
        offset = self.points - self.points.mean(axis=0)
        return int(np.argmin(np.einsum("nc,nc->n", offset, offset)))

    def nearest_node(self) -> int:
        """The node nearest to the camera."""
        return int(np.argmin(self.points[:, 2]))

    def extent(self) -> float:
        """Distance from the mean within which nearly all nodes lie [m]."""
        offset = np.linalg.norm(self.points - self.points.mean(axis=0), axis=1)
        return float(np.percentile(offset, 98))

    def distances(self, sources: list[int]) -> NDArray[np.float64]:
        """Distance along the surface from the nearest of some nodes [m], shape (node_count,)."""
        far = dijkstra(self._graph, directed=False, indices=sources, min_only=True)
        # Pixels that touch only at removed ones cannot be reached: never the farthest.
        return np.where(np.isfinite(far), far, 0.0)

    def outline(self, member: NDArray[np.bool_]) -> float:
        """Length of the outline of some nodes, holes included [pixels]."""
        edges = self._edges[: self._straight_count]
        inside = int((member[edges[:, 0]] & member[edges[:, 1]]).sum())
        return (4 * int(member.sum()) - 2 * inside) * np.pi / 4  # pi / 4: see `link`

    def link(self, member: NDArray[np.bool_]) -> tuple[float, NDArray[np.float64] | None]:
        """How some nodes join the others.

        Args:
            member: Which nodes, shape (node_count,).

        Returns:
            Length of the border between them and the others [m], and its middle [m], shape (3,),
            or None if they are all.
        """
        edges = self._edges[: self._straight_count]
        crossing = edges[member[edges[:, 0]] != member[edges[:, 1]]]
        if len(crossing) == 0:
            return 0.0, None
        ends = self.points[crossing]  # (nedge, 2, 3)
        # Each straight edge that crosses stands for one pixel width of border; a slanted border
        # is crossed sqrt(2) times as often as it is long, on average 4 / pi.
        width = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        return float(width.sum() * np.pi / 4), ends.mean(axis=(0, 1))
