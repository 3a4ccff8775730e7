"""The parametric hand: template, skeleton, skin and shape space (thesis II.3, Eq. II.1-II.9).

`HandModel` is the artifact; `HandModel.shaped` gives the `ShapedHand` of one person, which is all
that kinematics, rendering and fitting need.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.files import UNREADABLE
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, check_side, mirror_axes, mirror_points, mirror_rotations
from handtrack.hand.skeleton import (
    BASE_BONES,
    BONE_ANGLES,
    BONE_PARENTS,
    DISTAL_BONES,
    NANGLE,
    NBONE,
)
from handtrack.transforms import rotvec_to_matrix

FORMAT_VERSION = 1

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapedHand:
    """One person's hand: what Eq. II.9 needs once alpha and beta are fixed. Metres, float64."""

    side: Side
    faces: NDArray[np.int32]
    """Triangles, outward counter-clockwise, shape (nface, 3)."""
    weight_bones: NDArray[np.int32]
    """Bones that move each vertex: the palm and one finger chain, shape (nvert, 3)."""
    weights: Float
    """Skinning weights w_ij, rows sum to one, shape (nvert, 3)."""
    local_vertices: Float
    """Scaled vertices in the frame of each bone that moves them (Eq. II.7), shape (nvert, 3, 3)."""
    local_normals: Float
    """Outward unit normals of the rest mesh in the frames of the same bones, shape (nvert, 3,
    3)."""
    bone_rotations: Float
    """Rotation from bone to parent at zero angles, shape (16, 3, 3)."""
    bone_origins: Float
    """Joint origins in the parent's frame, shape (16, 3)."""
    tip_offsets: Float
    """Fingertips in the frames of the distal bones, shape (5, 3)."""
    angle_axes: Float
    """Axis of each joint angle in its bone's frame, shape (21, 3)."""
    limits: Float
    """Lower and upper joint limits [rad], shape (21, 2)."""
    rest_angles: Float
    """Joint angles of the template's rest pose [rad], shape (21,)."""
    cut_x: float
    """Palm-frame x of the cut through the forearm [m], negative."""

    @property
    def nvert(self) -> int:
        """Number of vertices."""
        return len(self.weights)

    @property
    def stub_vertices(self) -> NDArray[np.bool_]:
        """Vertices of the forearm stub: moved by the palm, behind the wrist; shape (nvert,)."""
        palm_x = np.where(self.weight_bones == 0, self.local_vertices[..., 0], np.inf)
        return np.asarray(palm_x.min(axis=1) <= 0.0)

    def as_right(self) -> ShapedHand:
        """The right hand of the same shape: this one, or its mirror image."""
        return self if self.side == "right" else _mirrored(self)

    def scaled(self, factor: float) -> ShapedHand:
        """The hand made larger or smaller as a whole."""
        lengths = ("local_vertices", "bone_origins", "tip_offsets", "cut_x")
        return replace(self, **{name: factor * getattr(self, name) for name in lengths})

    @property
    def bone_lengths(self) -> Float:
        """From each bone's joint to the next or the tip [m], shape (16,); palm: to middle MCP."""
        lengths = np.empty(NBONE)
        lengths[0] = np.linalg.norm(self.bone_origins[BASE_BONES[2]])
        for bone, parent in enumerate(BONE_PARENTS):
            if parent > 0:
                lengths[parent] = np.linalg.norm(self.bone_origins[bone])
        lengths[list(DISTAL_BONES)] = np.linalg.norm(self.tip_offsets, axis=1)
        return lengths


@dataclass(frozen=True, slots=True, kw_only=True)
class HandModel:
    """The right hand's template and shape space, as in `models/hand.npz`. Metres, float64."""

    vertices: Float
    """Template in the palm frame at `rest_angles`, shape (nvert, 3)."""
    faces: NDArray[np.int32]
    """Triangles of the watertight mesh, outward counter-clockwise, shape (nface, 3)."""
    weight_bones: NDArray[np.int32]
    """Bones that move each vertex: the palm and one finger chain, shape (nvert, 3)."""
    weights: Float
    """Skinning weights, rows sum to one, shape (nvert, 3)."""
    bone_rotations: Float
    """Rotation from bone to parent at zero angles, shape (16, 3, 3)."""
    bone_origins: Float
    """Template joint origins in the parent's frame, shape (16, 3)."""
    tip_offsets: Float
    """Template fingertips in the distal bones' frames, shape (5, 3)."""
    dof_axes: Float
    """Axis of each joint angle in its bone's frame, shape (21, 3)."""
    rest_angles: Float
    """Joint angles of the template's rest pose [rad], shape (21,)."""
    limits: Float
    """Lower and upper joint limits [rad], shape (21, 2)."""
    scale_mean: Float
    """S_0 of Eq. II.4: overall scale, then one scale per bone, shape (17,)."""
    scale_basis: Float
    """C_S of Eq. II.4, one column per standard deviation, shape (17, nalpha)."""
    offset_mean: Float
    """Q_0 of Eq. II.6 for the vertices and the five base joints [m], shape (nvert + 5, 3)."""
    offset_basis: Float
    """C_Q of Eq. II.6, one column per standard deviation [m], shape (nvert + 5, 3, nbeta)."""
    cut_x: float
    """Palm-frame x of the cut through the forearm [m], negative."""

    @property
    def nalpha(self) -> int:
        """Number of bone-scale coordinates."""
        return self.scale_basis.shape[1]

    @property
    def nbeta(self) -> int:
        """Number of vertex-offset coordinates."""
        return self.offset_basis.shape[2]

    @classmethod
    def load(cls, path: str | Path | None = None) -> HandModel:
        """Read the model; without a path, the one that comes with handtrack.

        Raises:
            MissingFileError: There is no such file.
            DamagedFileError: The file is not a hand model of a known format.
        """
        path = Path(path) if path is not None else artifact_path("hand.npz")
        if not path.is_file():
            raise MissingFileError(
                f"no hand model at {path}; models/README.md says how to build it"
            )
        try:
            with np.load(path, allow_pickle=False) as data:
                version = int(data["format_version"])
                if version != FORMAT_VERSION:
                    raise DamagedFileError(
                        f"{path} has hand model format {version}; this version reads"
                        f" {FORMAT_VERSION}"
                    )
                arrays = {f.name: np.asarray(data[f.name]) for f in fields(cls)}
        except UNREADABLE as error:
            if isinstance(error, DamagedFileError):
                raise
            raise DamagedFileError(f"{path} is not a hand model: {error}") from error
        _check_arrays(arrays, path)
        cut_x = float(arrays.pop("cut_x"))
        for name, value in arrays.items():
            arrays[name] = value.astype(np.int32 if value.dtype.kind == "i" else np.float64)
        return cls(**arrays, cut_x=cut_x)

    def sample_shape(self, rng: np.random.Generator, *, deviation: float = 1.0) -> HandShape:
        """Draw a plausible shape: alpha and beta normal with the given deviation."""
        return HandShape(
            alpha=deviation * rng.standard_normal(self.nalpha),
            beta=deviation * rng.standard_normal(self.nbeta),
        )

    def scales(self, shape: HandShape) -> Float:
        """Bone scales S(alpha), shape (17,), entry 0 times the overall scale (Eq. II.4)."""
        alpha = _padded(shape.alpha, self.nalpha, "alpha")
        scales = self.scale_mean + self.scale_basis @ alpha
        scales[0] *= shape.scale
        return scales

    def shaped(self, shape: HandShape | None = None, *, side: str = "right") -> ShapedHand:
        """Template and skeleton of one person (Eq. II.1 to II.7).

        Args:
            shape: Coordinates in the shape space; the mean hand when None.
            side: "right" or "left"; the left hand is the mirror image.

        Returns:
            The hand of that person.
        """
        shape = shape if shape is not None else HandShape()
        side = check_side(side)
        scales = self.scales(shape)
        offsets = self.offset_mean + self.offset_basis @ _padded(shape.beta, self.nbeta, "beta")

        # II.1 and II.5: local template vertices in every bone that moves them.
        rotations, origins = self.rest_skeleton()
        bones = self.weight_bones
        moved = self.vertices[:, None] - origins[bones] + offsets[: len(self.vertices), None]
        local = np.einsum("vkji,vkj->vki", rotations[bones], moved)
        # II.3: s_g on all axes, s_j along the bone (x).
        stretch = np.full((NBONE, 3), scales[0])
        stretch[:, 0] *= scales[1:]
        local = local * stretch[bones]

        joints = self.bone_origins.copy()
        joints[list(BASE_BONES)] += offsets[len(self.vertices) :]
        parents = np.array(BONE_PARENTS)
        joints[1:] *= stretch[parents[1:]]
        tips = self.tip_offsets * stretch[list(DISTAL_BONES)]
        normals = _rest_normals(local, self.weights, bones, self.faces, self, joints)

        hand = ShapedHand(
            side="right",
            faces=self.faces,
            weight_bones=bones,
            weights=self.weights,
            local_vertices=local,
            local_normals=normals,
            bone_rotations=self.bone_rotations,
            bone_origins=joints,
            tip_offsets=tips,
            angle_axes=self.dof_axes,
            limits=self.limits,
            rest_angles=self.rest_angles,
            cut_x=float(self.cut_x * stretch[0, 0]),
        )
        return hand if side == "right" else _mirrored(hand)

    def rest_skeleton(self) -> tuple[Float, Float]:
        """Frames of the template's bones in the palm frame at the rest angles.

        Returns:
            Rotations, shape (16, 3, 3), and origins [m], shape (16, 3).
        """
        return skeleton_frames(
            self.bone_rotations, self.bone_origins, self.dof_axes, self.rest_angles
        )


_SHAPES: dict[str, tuple[int | str, ...]] = {
    "vertices": ("nvert", 3), "faces": ("nface", 3),
    "weight_bones": ("nvert", 3), "weights": ("nvert", 3),
    "bone_rotations": (NBONE, 3, 3), "bone_origins": (NBONE, 3), "tip_offsets": (5, 3),
    "dof_axes": (NANGLE, 3), "rest_angles": (NANGLE,), "limits": (NANGLE, 2),
    "scale_mean": (NBONE + 1,), "scale_basis": (NBONE + 1, "nalpha"),
    "offset_mean": ("nvert + 5", 3), "offset_basis": ("nvert + 5", 3, "nbeta"), "cut_x": (),
}  # fmt: skip
"""Shape of every array of the artifact; names stand for any size, the same wherever they appear."""


def _check_arrays(arrays: dict[str, NDArray], path: Path) -> None:
    """Check shapes, kinds, finiteness and indices of what was read."""
    sizes: dict[int | str, int] = {}
    for name, shape in _SHAPES.items():
        value = arrays[name]
        if name == "vertices" and value.ndim:
            sizes["nvert + 5"] = len(value) + 5
        fits = value.ndim == len(shape) and all(
            found == (size if isinstance(size, int) else sizes.setdefault(size, found))
            for found, size in zip(value.shape, shape, strict=True)
        )
        if not fits:
            raise DamagedFileError(f"{path}: {name} has shape {value.shape}; expected {shape}")
        kind = "i" if name in ("faces", "weight_bones") else "f"
        if value.dtype.kind != kind or (kind == "f" and not np.isfinite(value).all()):
            raise DamagedFileError(
                f"{path}: {name} holds {value.dtype} values; expected finite numbers of kind"
                f" {kind!r}"
            )
    for name, count in (("faces", sizes["nvert"]), ("weight_bones", NBONE)):
        if arrays[name].size and not 0 <= arrays[name].min() <= arrays[name].max() < count:
            raise DamagedFileError(f"{path}: {name} has entries outside 0 to {count - 1}")


def _bone_levels() -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Bones as far from the palm as each other, nearest first, and their parents."""
    depths = [0]
    for parent in BONE_PARENTS[1:]:
        depths.append(depths[parent] + 1)
    levels = [np.flatnonzero(np.equal(depths, depth)) for depth in range(1, max(depths) + 1)]
    return [(bones, np.array(BONE_PARENTS)[bones]) for bones in levels]


_BONE_LEVELS = _bone_levels()


def skeleton_frames(
    bone_rotations: Float, bone_origins: Float, axes: Float, angles: Float
) -> tuple[Float, Float]:
    """Frames of all bones in the palm frame.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (16, 3, 3).
        bone_origins: Joint origins in the parent's frame [m], shape (16, 3).
        axes: Axis of each angle in its bone's frame, shape (21, 3).
        angles: Joint angles [rad], shape (..., 21).

    Returns:
        Rotations, shape (..., 16, 3, 3), and origins [m], shape (..., 16, 3).
    """
    angles = np.asarray(angles, np.float64)
    still = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 1, 3, 3))
    turns = np.concatenate([rotvec_to_matrix(angles[..., None] * axes), still], axis=-3)
    # MuJoCo's order: the first angle of a bone is the outermost rotation. The last turn is none.
    outer, inner = BONE_ANGLES.T
    rotations = bone_rotations @ turns[..., outer, :, :] @ turns[..., inner, :, :]
    origins = np.broadcast_to(bone_origins, (*rotations.shape[:-2], 3)).copy()
    rotations[..., 0, :, :], origins[..., 0, :] = np.eye(3), 0.0
    for bones, parents in _BONE_LEVELS:
        parent = rotations[..., parents, :, :]
        moved = (parent @ origins[..., bones, :, None])[..., 0]
        origins[..., bones, :] = origins[..., parents, :] + moved
        rotations[..., bones, :, :] = parent @ rotations[..., bones, :, :]
    return rotations, origins


def _padded(vector: Float, size: int, name: str) -> Float:
    if len(vector) > size:
        raise InputError(f"shape.{name} has {len(vector)} entries; this model has {size}")
    return np.pad(vector, (0, size - len(vector)))


def _rest_normals(
    local: Float, weights: Float, bones: NDArray, faces: NDArray, model: HandModel, joints: Float
) -> Float:
    """Area-weighted vertex normals of the person's rest mesh, in the bones' frames."""
    rotations, origins = skeleton_frames(
        model.bone_rotations, joints, model.dof_axes, model.rest_angles
    )
    points = np.einsum("vkij,vkj->vki", rotations[bones], local) + origins[bones]
    vertices = np.einsum("vk,vki->vi", weights, points)
    normals = vertex_normals(vertices, faces)
    return np.einsum("vkji,vj->vki", rotations[bones], normals)


def vertex_normals(vertices: Float, faces: NDArray) -> Float:
    """Area-weighted unit normals, shape (nvert, 3), of one mesh."""
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _mirrored(hand: ShapedHand) -> ShapedHand:
    return ShapedHand(
        side="left" if hand.side == "right" else "right",
        faces=np.ascontiguousarray(hand.faces[:, ::-1]),
        weight_bones=hand.weight_bones,
        weights=hand.weights,
        local_vertices=mirror_points(hand.local_vertices),
        local_normals=mirror_points(hand.local_normals),
        bone_rotations=mirror_rotations(hand.bone_rotations),
        bone_origins=mirror_points(hand.bone_origins),
        tip_offsets=mirror_points(hand.tip_offsets),
        angle_axes=mirror_axes(hand.angle_axes),
        limits=hand.limits,
        rest_angles=hand.rest_angles,
        cut_x=hand.cut_x,
    )
