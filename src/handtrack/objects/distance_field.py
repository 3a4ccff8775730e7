"""Signed distance from an object's surface on a grid, negative inside (thesis III.4.1.4).

The object is still while the grip closes, so its distances are measured once, and every later
question, on the host or in a kernel, is a look-up in a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.kernels.distance_field import DistanceGrid, measure_distances
from handtrack.objects.rigid_object import RigidObject, check_surface

Float = NDArray[np.float64]

MOST_CELLS = 20_000_000
"""Largest grid that is made: 80 MB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceField:
    """Signed distances on a regular grid in the object's frame."""

    values: NDArray[np.float32]
    """Distances [m], negative inside, shape (nx, ny, nz)."""
    origin: Float
    """Place of the first grid point [m], shape (3,)."""
    spacing: float
    """Distance between grid points [m]."""

    @classmethod
    def of(
        cls, body: RigidObject | trimesh.Trimesh, *, spacing: float = 0.002, margin: float = 0.03,
        device: str | None = None,
    ) -> DistanceField:  # fmt: skip
        """Measure a body.

        Closed parts that overlap are measured one by one and the smallest distance is kept, so that
        surfaces inside the union do not count.

        Args:
            body: The object, or a closed mesh.
            spacing: Distance between grid points [m].
            margin: How far the grid reaches beyond the bounding box [m].
            device: "cpu", "cuda:N" or None for the best there is.

        Raises:
            InputError: The mesh is not closed, spacing or margin make no sense, or the grid would
                be too large.
        """
        if not (np.isfinite(spacing) and spacing > 0 and np.isfinite(margin) and margin >= spacing):
            raise InputError(
                f"spacing is {spacing} m and margin {margin} m; expected more than 0 m, and a "
                "margin of at least the spacing"
            )
        if isinstance(body, trimesh.Trimesh):
            check_surface(body, "the mesh")
        vertices = np.asarray(body.vertices, np.float64)
        faces = np.asarray(body.faces, np.int32)
        origin = vertices.min(0) - margin
        shape = np.ceil((np.ptp(vertices, axis=0) + 2 * margin) / spacing).astype(int) + 1
        if np.prod(shape.astype(float)) > MOST_CELLS:
            raise InputError(
                f"a grid of {' x '.join(map(str, shape))} points is too large: give more spacing"
            )
        where = resolve_device(device)
        reach = float(np.linalg.norm(shape * spacing))
        values = wp.full(tuple(shape.tolist()), reach, dtype=float, device=where)
        points = wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=where)
        for part in _closed_parts(vertices, faces):
            mesh = wp.Mesh(
                points, wp.array(part.ravel(), dtype=int, device=where),
                support_winding_number=True,
            )  # fmt: skip
            measure_distances(mesh, tuple(origin), spacing, reach, values=values)
        return cls(values=np.asarray(values.numpy(), np.float32), origin=origin, spacing=spacing)

    def upload(self, device: wp.Device) -> Any:
        """The `DistanceGrid` that kernels read."""
        grid: Any = DistanceGrid()
        grid.values = wp.array(self.values, dtype=float, device=device)
        grid.origin = wp.vec3(*self.origin)
        grid.spacing = self.spacing
        return grid

    def distance(self, points: ArrayLike) -> Float:
        """Signed distances [m], shape (...), at points [m], shape (..., 3).

        Outside the grid: the distance at the nearest border point plus the way there.
        """
        points = np.asarray(points, np.float64)
        local = (points.reshape(-1, 3) - self.origin) / self.spacing
        inside = local.clip(0.0, np.array(self.values.shape) - 1.0)
        values = map_coordinates(self.values, inside.T, output=np.float64, order=1, mode="nearest")
        values += self.spacing * np.linalg.norm(local - inside, axis=1)
        return values.reshape(points.shape[:-1])

    def gradient(self, points: ArrayLike) -> Float:
        """Slope of the distance, shape (..., 3), at points [m], shape (..., 3).

        Central differences over two cells; of length one except near edges and middle planes.
        """
        points = np.asarray(points, np.float64)
        step = self.spacing * np.eye(3)
        around = points[..., None, None, :] + np.stack([step, -step])
        ahead, behind = np.moveaxis(self.distance(around), -2, 0)
        return (ahead - behind) / (2.0 * self.spacing)

    def normal(self, points: ArrayLike) -> Float:
        """Unit directions away from the surface, shape (..., 3), at points [m], shape (..., 3)."""
        slope = self.gradient(points)
        return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)

    def project(self, points: ArrayLike, *, iterations: int = 3) -> Float:
        """Points of the surface near to points [m], shape (..., 3), by steps along the normal."""
        points = np.array(points, np.float64)
        for _ in range(iterations):
            points -= self.distance(points)[..., None] * self.normal(points)
        return points


def _closed_parts(vertices: Float, faces: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Triangles of each part that hangs together; all as one where a part bounds a hole."""
    count = len(vertices)
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    of_face = labels[faces[:, 0]]
    parts = [faces[of_face == label] for label in np.unique(of_face)]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    signed = np.bincount(of_face, np.einsum("fi,fi->f", a, np.cross(b, c)))
    return parts if (signed[np.unique(of_face)] > 0).all() else [faces]
