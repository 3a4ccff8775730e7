"""Shapes of everyday things: closed meshes, and convex pieces that stand for them in collisions.

Lengths in metres. Shapes stand upright, z up; where their origin is does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.transforms import rotvec_to_matrix

Float = NDArray[np.float64]

SECTORS = 32
"""Sides of round shapes."""

WALL_SECTORS = 16
"""Convex pieces around a hollow wall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Primitive:
    """A shape that a simulator knows exactly."""

    kind: Literal["sphere", "box", "cylinder", "capsule"]
    """Which; cylinders and capsules stand along z."""
    size: tuple[float, ...]
    """Sizes [m] in MuJoCo's order: radius; half edges; radius and half length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A closed surface and its convex pieces."""

    mesh: trimesh.Trimesh
    """Closed, outward; may consist of closed parts that overlap."""
    pieces: tuple[Float, ...] | None = None
    """Corners of convex pieces whose union is the shape [m], each (n, 3); None: not known."""
    primitive: Primitive | None = None
    """The shape itself, when it is one."""


def sphere(diameter: float) -> Shape:
    """A ball."""
    radius = 0.5 * _length(diameter)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Shape(mesh=mesh, primitive=Primitive(kind="sphere", size=(radius,)))


def box(x: float, y: float, z: float) -> Shape:
    """A block with these edges."""
    edges = [_length(edge) for edge in (x, y, z)]
    half = (0.5 * edges[0], 0.5 * edges[1], 0.5 * edges[2])
    mesh = trimesh.creation.box(extents=edges)
    return Shape(mesh=mesh, primitive=Primitive(kind="box", size=half))


def cylinder(diameter: float, height: float) -> Shape:
    """A cylinder that stands on its end."""
    radius, half = 0.5 * _length(diameter), 0.5 * _length(height)
    mesh = trimesh.creation.cylinder(radius=radius, height=2 * half, sections=2 * SECTORS)
    return Shape(mesh=mesh, primitive=Primitive(kind="cylinder", size=(radius, half)))


def lying_cylinder(diameter: float, length: float) -> Shape:
    """A cylinder that lies along y."""
    shape = cylinder(diameter, length)
    mesh = shape.mesh.copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [1, 0, 0]))
    return Shape(mesh=mesh, pieces=(np.array(mesh.vertices),))


def prism(sides: int, diameter: float, height: float) -> Shape:
    """An upright prism with a regular base in a circle of this diameter."""
    return frustum(sides, diameter, diameter, height)


def pyramid(base: float, height: float) -> Shape:
    """A pyramid with a square base, cut where its point would be too sharp to touch."""
    return frustum(4, np.sqrt(2.0) * base, 0.12 * np.sqrt(2.0) * base, height)


def frustum(sides: int, bottom: float, top: float, height: float) -> Shape:
    """A convex body between two regular polygons, given by the diameters of their circles."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    corners = np.concatenate([
        _ring(angles, 0.5 * _length(bottom), 0.0), _ring(angles, 0.5 * top, _length(height))
    ])  # fmt: skip
    return convex(corners)


def ellipsoid(x: float, y: float, z: float) -> Shape:
    """An egg with these diameters."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return convex(mesh.vertices * [_length(x), _length(y), _length(z)])


def convex(corners: ArrayLike) -> Shape:
    """The convex hull of points, shape (n, 3)."""
    mesh = trimesh.Trimesh(corners, process=False).convex_hull
    return Shape(mesh=mesh, pieces=(np.array(mesh.vertices),))


def turned(profile: Sequence[tuple[float, float]]) -> Shape:
    """A solid turned on a lathe.

    Args:
        profile: Radius and height [m] from the bottom to the top; both ends are closed by discs.
    """
    points = np.array(profile, np.float64)
    angles = 2 * np.pi * np.arange(SECTORS) / SECTORS
    pieces = [
        np.concatenate([_ring(angles, r, z) for r, z in points[k : k + 2]])
        for k in range(len(points) - 1)
        if points[k + 1, 1] > points[k, 1]
    ]
    outline = [(0.0, points[0, 1]), *map(tuple, points), (0.0, points[-1, 1])]
    return Shape(mesh=_revolved(outline), pieces=tuple(pieces))


def vessel(
    outside: Sequence[tuple[float, float]], wall: float, floor: float, *, foot: int = 0
) -> Shape:
    """A hollow body turned on a lathe, open at the top.

    Args:
        outside: Radius and height [m] of the outside, from the bottom to the rim.
        wall: Thickness of the wall [m].
        floor: Thickness of the floor [m].
        foot: So many segments from the bottom are solid.
    """
    points = np.array(outside, np.float64)
    solid, hollow = points[: foot + 1], points[foot:]
    bottom = hollow[0, 1] + floor
    heights = np.concatenate([[bottom], hollow[hollow[:, 1] > bottom + 1e-6, 1]])
    inside = np.stack(
        [np.maximum(np.interp(heights, hollow[:, 1], hollow[:, 0]) - wall, 1e-3), heights], axis=1
    )
    outline = [(0.0, points[0, 1]), *map(tuple, points)]
    outline += [*map(tuple, inside[::-1]), (0.0, float(bottom))]
    angles = 2 * np.pi * np.arange(SECTORS) / SECTORS
    radius = float(np.interp(bottom, hollow[:, 1], hollow[:, 0]))
    solids = [*solid, (radius, bottom)] if foot else [hollow[0], (radius, bottom)]
    pieces = [
        np.concatenate([_ring(angles, r, z) for r, z in solids[k : k + 2]])
        for k in range(len(solids) - 1)
        if solids[k + 1][1] > solids[k][1]
    ]
    outer = np.interp(inside[:, 1], hollow[:, 1], hollow[:, 0])
    for k in range(len(inside) - 1):
        for sector in range(WALL_SECTORS):
            ends = 2 * np.pi * np.array([sector, sector + 0.5, sector + 1.0]) / WALL_SECTORS
            pieces.append(np.concatenate([
                _ring(ends, r, inside[level, 1])
                for level in (k, k + 1) for r in (outer[level], inside[level, 0])
            ]))  # fmt: skip
    return Shape(mesh=_revolved(outline), pieces=tuple(pieces))


def tube(centres: ArrayLike, radii: ArrayLike) -> Shape:
    """A tube of varying thickness along points, such as a banana or a handle.

    Args:
        centres: Points along the middle [m], shape (n, 3).
        radii: Radius at each [m], shape (n,).
    """
    middle, thick = np.asarray(centres, np.float64), np.asarray(radii, np.float64)
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    # One direction that is never along the tube, turned with it as little as possible.
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    rings = []
    angles = 2 * np.pi * np.arange(SECTORS // 2) / (SECTORS // 2)
    for point, axis, radius in zip(middle, along, thick, strict=True):
        side = side - axis * (side @ axis)
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        rings.append(
            point + radius * (np.outer(np.cos(angles), side) + np.outer(np.sin(angles), other))
        )
    pieces = tuple(np.concatenate(rings[k : k + 2]) for k in range(len(rings) - 1))
    return Shape(mesh=_tube_mesh(rings), pieces=pieces)


def joined(parts: Sequence[Shape]) -> Shape:
    """Several shapes in one, overlapping where they hold together."""
    pieces: list[Float] = []
    for part in parts:
        if part.pieces is None:
            if not part.mesh.is_convex:
                raise InputError("only convex parts, or parts of convex pieces, can be joined")
            pieces.append(np.array(part.mesh.vertices))
        else:
            pieces += part.pieces
    mesh = trimesh.util.concatenate([part.mesh for part in parts])
    assert isinstance(mesh, trimesh.Trimesh)
    return Shape(mesh=mesh, pieces=tuple(pieces))


def moved(shape: Shape, offset: ArrayLike, *, turn: ArrayLike | None = None) -> Shape:
    """The shape turned by a rotation vector [rad], then moved [m]."""
    R = np.eye(3) if turn is None else rotvec_to_matrix(turn)
    mesh = shape.mesh.copy()
    mesh.vertices = mesh.vertices @ R.T + np.asarray(offset)
    known = shape.pieces if shape.pieces is not None else (np.array(shape.mesh.vertices),)
    if shape.pieces is None and not shape.mesh.is_convex:
        raise InputError("a shape without convex pieces that is not convex cannot be moved")
    return Shape(mesh=mesh, pieces=tuple(piece @ R.T + np.asarray(offset) for piece in known))


def _length(value: float) -> float:
    if not np.isfinite(value) or value <= 0:
        raise InputError(f"a length is {value}; expected more than 0 m")
    return float(value)


def _ring(angles: Float, radius: float, height: float) -> Float:
    """Points of a level circle, shape (n, 3)."""
    flat = np.stack([np.cos(angles), np.sin(angles)], axis=1) * max(float(radius), 1e-4)
    return np.concatenate([flat, np.full((len(angles), 1), height)], axis=1)


def _revolved(outline: Sequence[tuple[float, float]]) -> trimesh.Trimesh:
    """Surface of an outline (radius, height) turned about z, outward."""
    mesh = trimesh.creation.revolve(np.array(outline, np.float64), sections=2 * SECTORS)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _tube_mesh(rings: Sequence[Float]) -> trimesh.Trimesh:
    """Closed surface through rings of equally many points, with a cap at each end."""
    count, sides = len(rings), len(rings[0])
    vertices = np.concatenate([*rings, rings[0].mean(axis=0)[None], rings[-1].mean(axis=0)[None]])
    k, after = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = []
    for ring in range(count - 1):
        a, b = ring * sides, (ring + 1) * sides
        faces += [
            np.stack([a + k, a + after, b + after], 1),
            np.stack([a + k, b + after, b + k], 1),
        ]
    first, last = count * sides, (count - 1) * sides
    faces.append(np.stack([after, k, np.full(sides, first)], 1))
    faces.append(np.stack([last + k, last + after, np.full(sides, first + 1)], 1))
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh
