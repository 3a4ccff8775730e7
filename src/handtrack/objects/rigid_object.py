"""An object that a hand can grasp: surface, convex pieces, mass and friction."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE, whole_file
from handtrack.objects.shapes import Primitive, Shape, sphere
from handtrack.optional import import_extra

Float = NDArray[np.float64]

FORMAT_VERSION = 1

SMALLEST, LARGEST = 0.005, 2.0
"""Longest edge of the bounding box of an object that makes sense here [m]."""

FRICTION = 0.8
"""Sliding friction of dry skin on most things."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidObject:
    """A rigid body of uniform density in its own frame: origin = centre of mass, z up at rest."""

    name: str
    """Its name."""
    vertices: Float
    """Vertices of the surface [m], shape (nvert, 3)."""
    faces: NDArray[np.int32]
    """Triangles, outward, closed, shape (nface, 3)."""
    pieces: tuple[Float, ...]
    """Corners of convex pieces that stand for it in collisions [m], each (n, 3)."""
    primitive: Primitive | None = None
    """What stands for it exactly, in place of the pieces."""
    mass: float
    """Mass [kg]."""
    friction: float = FRICTION
    """Coefficient of sliding friction against skin."""
    unit_inertia: Float = field(repr=False)
    """Inertia of the same body of 1 kg about its centre of mass [m^2], shape (3, 3)."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: Mass or friction is unusable.
        """
        if not (np.isfinite(self.mass) and self.mass > 0):
            raise InputError(f"mass of {self.name} is {self.mass}; expected more than 0 kg")
        if not (np.isfinite(self.friction) and self.friction >= 0):
            raise InputError(f"friction of {self.name} is {self.friction}; expected at least 0")

    @property
    def inertia(self) -> Float:
        """Inertia about the centre of mass [kg m^2], shape (3, 3)."""
        return self.mass * self.unit_inertia

    @property
    def rest_height(self) -> float:
        """Height of the centre of mass over the table it stands on [m]."""
        return -float(self.vertices[:, 2].min())

    @property
    def extents(self) -> Float:
        """Edges of the bounding box [m], shape (3,)."""
        return np.ptp(self.vertices, axis=0)

    @classmethod
    def of_shape(
        cls, shape: Shape, *, name: str, mass: float | None = None, density: float | None = None,
        friction: float = FRICTION,
    ) -> RigidObject:  # fmt: skip
        """An object of a shape.

        Where parts of the shape overlap, their common volume counts twice in centre and inertia.

        Args:
            shape: The shape.
            name: Name of the object.
            mass: Mass [kg].
            density: Density [kg/m^3], in place of the mass; that of soft wood (500) without both.
            friction: Coefficient of sliding friction.

        Raises:
            InputError: The surface is open, inverted, empty or of absurd size, or mass and density
                are both given.
        """
        mesh = shape.mesh
        check_surface(mesh, name)
        if mass is not None and density is not None:
            raise InputError(f"mass and density of {name} are both given: leave one out")
        centre, volume = np.array(mesh.center_mass), float(mesh.volume)
        pieces = decomposed(mesh) if shape.pieces is None and not mesh.is_convex else shape.pieces
        if pieces is None:
            pieces = (np.array(mesh.vertices),)
        return cls(
            name=name, vertices=np.array(mesh.vertices) - centre,
            faces=np.array(mesh.faces, np.int32),
            pieces=tuple(np.asarray(piece) - centre for piece in pieces),
            primitive=shape.primitive,
            mass=mass if mass is not None else volume * (500.0 if density is None else density),
            friction=friction, unit_inertia=np.array(mesh.moment_inertia) / volume,
        )  # fmt: skip

    @classmethod
    def from_mesh(
        cls, mesh: trimesh.Trimesh | str | Path, *, name: str | None = None,
        mass: float | None = None, density: float | None = None, friction: float = FRICTION,
        scale: float = 1.0,
    ) -> RigidObject:  # fmt: skip
        """An object of any closed mesh; what is not convex is cut into convex pieces (CoACD).

        Args:
            mesh: The surface in metres, or a file that trimesh reads.
            name: Name of the object; that of the file without.
            mass: Mass [kg].
            density: Density [kg/m^3], in place of the mass.
            friction: Coefficient of sliding friction.
            scale: The mesh is made so many times as large, 0.001 for millimetres.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is no mesh.
            InputError: The surface is open, inverted, empty or of absurd size.
            MissingDependencyError: It is not convex and CoACD is not installed.
        """
        if not isinstance(mesh, trimesh.Trimesh):
            path = Path(mesh)
            name, mesh = name or path.stem, read_mesh(path)
        name = name or "object"
        if not (np.isfinite(scale) and scale > 0):
            raise InputError(f"scale of {name} is {scale}; expected more than 0")
        surface = trimesh.Trimesh(np.array(mesh.vertices) * scale, mesh.faces, process=True)
        surface.merge_vertices()
        return cls.of_shape(
            Shape(mesh=surface), name=name, mass=mass, density=density, friction=friction
        )

    @classmethod
    def sphere(cls, radius: float, *, mass: float, friction: float = FRICTION) -> RigidObject:
        """A ball of a radius [m]."""
        return cls.of_shape(sphere(2.0 * radius), name="sphere", mass=mass, friction=friction)

    def save(self, path: str | Path) -> None:
        """Write to .npz."""
        corners = np.concatenate(self.pieces)
        primitive = self.primitive
        with whole_file(Path(path)) as file:
            np.savez_compressed(
                file, format_version=FORMAT_VERSION, name=self.name, vertices=self.vertices,
                faces=self.faces, corners=corners,
                piece_sizes=np.array([len(piece) for piece in self.pieces]),
                primitive="" if primitive is None else primitive.kind,
                primitive_size=np.array(() if primitive is None else primitive.size, np.float64),
                mass=self.mass, friction=self.friction, unit_inertia=self.unit_inertia,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> RigidObject:
        """Read what `save` wrote.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is no object.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"no object at {path}")
        try:
            with np.load(path, allow_pickle=False) as data:
                if int(data["format_version"]) != FORMAT_VERSION:
                    raise DamagedFileError(f"{path} has an unknown format")
                kind = str(data["primitive"])
                ends = np.cumsum(data["piece_sizes"])[:-1]
                return cls(
                    name=str(data["name"]), vertices=data["vertices"], faces=data["faces"],
                    pieces=tuple(np.split(data["corners"], ends)),
                    primitive=None if not kind else Primitive(
                        kind=kind, size=tuple(data["primitive_size"].tolist())  # type: ignore[arg-type]
                    ),
                    mass=float(data["mass"]), friction=float(data["friction"]),
                    unit_inertia=data["unit_inertia"],
                )  # fmt: skip
        except UNREADABLE as error:
            raise DamagedFileError(f"{path} is no object: {error}") from error


def check_surface(mesh: trimesh.Trimesh, name: str) -> None:
    """Check that a surface bounds a body.

    Raises:
        InputError: It is empty, open, inverted, without volume, or of absurd size.
    """
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise InputError(f"the mesh of {name} is empty or holds numbers that are not finite")
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST <= longest <= LARGEST:
        raise InputError(
            f"{name} is {longest:.4g} m long; expected {SMALLEST:g} to {LARGEST:g} m: "
            "give a scale, such as 0.001 for a mesh in millimetres"
        )
    if not mesh.is_watertight:
        raise InputError(f"the mesh of {name} is open: close its holes first")
    if not mesh.is_winding_consistent:
        raise InputError(f"triangles of {name} face both ways: make their order consistent first")
    smallest = 1e-6 * longest**3
    if mesh.volume < -smallest:
        raise InputError(f"the mesh of {name} is inside out: invert its triangles")
    if mesh.volume < smallest:
        raise InputError(f"the mesh of {name} has no volume")


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh file as one mesh.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: The file is no mesh.
    """
    if not path.is_file():
        raise MissingFileError(f"no mesh at {path}")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh's readers raise whatever their format's parser does
        raise DamagedFileError(f"{path} is not readable as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else None
    if mesh is None or len(mesh.faces) == 0:
        raise DamagedFileError(f"{path} holds no triangles")
    return mesh


def decomposed(mesh: trimesh.Trimesh, *, seed: int = 0) -> tuple[Float, ...]:
    """Corners of convex pieces whose union is nearly the body [m], by CoACD (Wei et al. 2022).

    Raises:
        MissingDependencyError: CoACD is not installed.
    """
    coacd = import_extra("coacd", "physics", "cutting a mesh into convex pieces")
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.array(mesh.vertices), np.array(mesh.faces)), threshold=0.04,
        preprocess_mode="auto", seed=seed,
    )  # fmt: skip
    return tuple(np.asarray(corners, np.float64) for corners, _ in parts)
