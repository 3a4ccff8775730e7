"""Folders of scan meshes: who was scanned in which pose, and the meshes themselves.

A file is named ``SUBJECT_POSE.ply`` or ``SUBJECT_POSE-REPEAT.ply`` (or ``.obj``); the subject's
name holds no underscore. docs/learning.md describes the format.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.side import Side, mirror_points

Float = NDArray[np.float64]
Unit = Literal["m", "cm", "mm"]

METRES: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres per unit."""

SIZES = (0.08, 0.8)
"""Diagonal of the box around a scan [m]: from a child's fist to a hand with its whole forearm."""

_NAME = re.compile(r"(?P<subject>[^_]+)_(?P<pose>.+?)(?:-(?P<repeat>\d+))?$")
_SUFFIXES = (".ply", ".obj")
_LEAST_PART = 0.02
"""Parts of a mesh with a smaller share of its triangles are debris."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanFile:
    """One scan that is there to be read."""

    path: Path
    subject: str
    pose: str
    """Name of the pose that the subject was asked for."""
    unit: Unit = "m"
    """Unit of the coordinates."""
    side: Side = "right"
    """Side of the scanned hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One scanned right hand."""

    name: str
    """What to call it in messages."""
    subject: str
    pose: str
    """Name of the pose that the subject was asked for."""
    points: Float
    """Vertices [m], shape (n, 3)."""
    normals: Float
    """Outward unit normals, shape (n, 3)."""
    on_edge: NDArray[np.bool_]
    """Vertices at the rim of a hole or of the cut through the arm, shape (n,)."""
    registered: bool
    """Whether point i is vertex i of the template."""

    @classmethod
    def of_mesh(
        cls,
        mesh: trimesh.Trimesh,
        *,
        subject: str,
        pose: str,
        name: str = "",
        template_faces: NDArray | None = None,
        max_points: int = 20_000,
    ) -> Scan:
        """Take from a mesh what learning needs.

        Args:
            mesh: Scan of a right hand [m].
            subject: Whose hand it is.
            pose: Name of the pose.
            name: What to call it in messages; subject and pose when empty.
            template_faces: Triangles of the template; a mesh with the same ones is registered.
            max_points: Keep at most so many points, drawn at random; the rim is kept whole.

        Raises:
            InputError: The mesh has no surface, or not the size of a hand.
        """
        name = name or f"{subject}_{pose}"
        registered = template_faces is not None and np.array_equal(mesh.faces, template_faces)
        if not registered:
            mesh = _cleaned(mesh, name)
        _check_size(np.asarray(mesh.vertices), name)
        rim = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
        on_edge = np.zeros(len(mesh.vertices), bool)
        on_edge[mesh.edges_sorted[rim].ravel()] = True
        points, normals = np.array(mesh.vertices), np.array(mesh.vertex_normals)
        inside = np.flatnonzero(~on_edge)
        if len(inside) > max_points and not registered:
            drawn = np.random.default_rng(len(inside)).choice(inside, max_points, replace=False)
            kept = np.sort(np.concatenate([np.flatnonzero(on_edge), drawn]))
            points, normals, on_edge = points[kept], normals[kept], on_edge[kept]
        return cls(
            name=name,
            subject=subject,
            pose=pose,
            points=points,
            normals=normals,
            on_edge=on_edge,
            registered=registered,
        )


def find_scans(
    folder: str | Path, *, unit: Unit = "m", side: Side = "right"
) -> dict[str, tuple[ScanFile, ...]]:
    """Scans of a folder by subject, both in the order of their names.

    Args:
        folder: Folder with the meshes.
        unit: Unit of their coordinates.
        side: Side of the scanned hands.

    Raises:
        MissingFileError: There is no such folder, or no scan in it.
        InputError: A mesh is not named as a scan.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(f"no folder of scans at {folder}")
    found: dict[str, list[ScanFile]] = {}
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES):
        match = _NAME.fullmatch(path.stem)
        if match is None:
            raise InputError(
                f"{path.name} does not tell whose scan it is: expected SUBJECT_POSE{path.suffix}"
                " or SUBJECT_POSE-REPEAT, such as s07_relaxed.ply"
            )
        scan = ScanFile(
            path=path, subject=match["subject"], pose=match["pose"], unit=unit, side=side
        )
        found.setdefault(scan.subject, []).append(scan)
    if not found:
        raise MissingFileError(f"no scan in {folder}: expected files SUBJECT_POSE.ply or .obj")
    return {subject: tuple(scans) for subject, scans in found.items()}


def read_scan(
    file: ScanFile, *, template_faces: NDArray | None = None, max_points: int = 20_000
) -> Scan:
    """Read one scan as that of a right hand: a left one is mirrored. See `Scan.of_mesh`.

    Args:
        file: The file.
        template_faces: Triangles of the template.
        max_points: Points to keep.

    Raises:
        DamagedFileError: The file is no triangle mesh.
        InputError: The mesh has not the size of a hand.
    """
    try:
        mesh = trimesh.load_mesh(file.path, process=False, maintain_order=True)
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            raise ValueError("it holds no triangles")
    except Exception as error:  # every reader of trimesh raises its own kinds
        raise DamagedFileError(
            f"{file.path} cannot be read as a triangle mesh: {error}; expected PLY or OBJ with"
            " faces"
        ) from error
    vertices = METRES[file.unit] * np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces)
    if file.side == "left":
        vertices, faces = mirror_points(vertices), faces[:, ::-1]
    return Scan.of_mesh(
        trimesh.Trimesh(vertices, faces, process=False),
        subject=file.subject,
        pose=file.pose,
        name=file.path.name,
        template_faces=template_faces,
        max_points=max_points,
    )


def _cleaned(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """The mesh with its seams closed, without debris and without points that nothing uses."""
    mesh = mesh.copy()
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    mesh.update_faces(finite[mesh.faces].all(axis=1))
    # Texture seams double vertices in OBJ files, and would look like the rims of holes.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if len(mesh.faces) < 200:
        raise InputError(
            f"{name} has {len(mesh.faces)} usable triangles; expected a hand's surface"
        )
    parts = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    )
    shares = np.bincount(parts) / len(parts)
    mesh.update_faces(shares[parts] >= _LEAST_PART)
    if not len(mesh.faces):
        raise InputError(f"{name} is all debris: none of its parts has {_LEAST_PART:.0%} of it")
    mesh.remove_unreferenced_vertices()
    return mesh


def _check_size(vertices: Float, name: str) -> None:
    """A hand measured in other units is told from one in metres by its size."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    low, high = SIZES
    if low <= size <= high:
        return
    units = [unit for unit, metres in METRES.items() if low <= size * metres <= high]
    advice = f"; it would fit in {units[0]!r}: give that unit" if units else ""
    raise InputError(f"{name} is {size:.3g} m across; expected a hand of {low} to {high} m{advice}")
