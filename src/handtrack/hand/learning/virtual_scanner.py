"""A scanner that exists only in memory: posed hands become meshes like those of real scanners.

The surface is tessellated anew, so that no vertex of the hand model survives; narrow gaps and some
round patches are missing, and every vertex is off by a little. Learning from scans is tested and
measured on such meshes, because their true surface is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from handtrack.errors import InputError
from handtrack.hand.model import HandModel

Float = NDArray[np.float64]

_FINE_PER_VERTEX = 3
"""Points of the subdivided surface for every vertex of the scan: fewer leave ragged triangles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannerOptions:
    """What a virtual scanner does to a surface."""

    vertices: int = 8000
    """Vertices of a scan, before holes; a hand of 187 mm then has edges of about 2.5 mm."""
    noise: float = 0.00025
    """Standard deviation of a vertex along each axis [m]."""
    holes: int = 4
    """Round patches that were not seen."""
    hole_radius: tuple[float, float] = (0.003, 0.008)
    """Smallest and largest radius of a patch [m]."""
    gap: float = 0.003
    """Surfaces that face each other nearer than about this [m] are not seen; 0 sees everything."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A number is out of range.
        """
        low, high = self.hole_radius
        if self.vertices < 100 or self.holes < 0 or not 0 <= low <= high:
            raise InputError(
                f"a scan of {self.vertices} vertices with {self.holes} holes of {low} to {high} m:"
                " expected at least 100 vertices, no negative number, and radii in order"
            )
        if not (self.noise >= 0 and self.gap >= 0):
            raise InputError(f"noise {self.noise} and gap {self.gap}: expected no negative length")


def open_faces(model: HandModel) -> NDArray[np.int32]:
    """Triangles of the skin, without the cap that closes the forearm around the last vertex."""
    return model.faces[(model.faces != len(model.vertices) - 1).all(axis=1)]


def virtual_scan(
    vertices: ArrayLike,
    faces: ArrayLike,
    rng: np.random.Generator,
    options: ScannerOptions | None = None,
) -> trimesh.Trimesh:
    """Scan a surface.

    Args:
        vertices: Vertices of the posed hand [m], shape (nvert, 3).
        faces: Its triangles, open where the arm was cut, shape (nface, 3).
        rng: Source of the tessellation, the holes and the noise.
        options: What the scanner does; the defaults when None.

    Returns:
        Mesh in the frame of `vertices`, [m].
    """
    options = options or ScannerOptions()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    while len(mesh.vertices) < _FINE_PER_VERTEX * options.vertices:
        mesh = mesh.subdivide()
    scan = _tessellated(mesh, options.vertices, rng)
    points, seen = np.array(scan.vertices), np.ones(len(scan.vertices), bool)
    if options.gap > 0:
        # Above a surface that faces nothing, the nearest surface is as far away as one has risen.
        clear = 0.7 * options.gap
        above = points + options.gap * scan.vertex_normals
        seen &= KDTree(points).query(above, distance_upper_bound=clear)[0] > clear
    centres = points[rng.choice(len(points), options.holes)]
    for centre, radius in zip(
        centres, rng.uniform(*options.hole_radius, options.holes), strict=True
    ):
        seen &= np.linalg.norm(points - centre, axis=1) > radius
    scan.update_faces(seen[scan.faces].all(axis=1))
    scan.remove_unreferenced_vertices()
    scan.vertices += options.noise * rng.standard_normal(scan.vertices.shape)
    return scan


def _tessellated(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> trimesh.Trimesh:
    """The surface on `count` of its points: triangles join three points whose regions meet."""
    points = np.asarray(mesh.vertices)
    seeds = rng.choice(len(points), count, replace=False)
    i, k = mesh.edges_unique.T
    along = csr_array((mesh.edges_unique_length, (i, k)), shape=(len(points), len(points)))
    nearest = dijkstra(
        along, directed=False, indices=seeds, min_only=True, return_predecessors=True
    )
    number = np.empty(len(points), np.int64)
    number[seeds] = np.arange(count)
    joined = number[nearest[2]][mesh.faces]
    a, b, c = joined.T
    joined = joined[(a != b) & (b != c) & (c != a)]
    kept = np.unique(np.sort(joined, axis=1), axis=0, return_index=True)[1]
    return trimesh.Trimesh(points[seeds], joined[kept], process=False)
