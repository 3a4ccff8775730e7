"""Hands uploaded to a device: the arrays of `ShapedHand` that kernels read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLE_BONES, BONE_ANGLES, BONE_PARENTS, NBONE, finger_of_bone


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceHand:
    """One or several hands of one topology on a device; arrays named as the kernels name them."""

    faces: wp.array
    weight_bones: wp.array
    weights: wp.array
    local_vertices: wp.array
    local_normals: wp.array
    bone_rotations: wp.array
    bone_origins: wp.array
    angle_axes: wp.array
    bone_parents: wp.array
    bone_angles: wp.array
    angle_bones: wp.array
    vertex_chains: wp.array
    vertex_is_hand: wp.array
    limits: wp.array
    tip_offsets: wp.array
    kept: NDArray[np.intp]
    """Numbers of the vertices that are there."""

    def resize(self, hands: Sequence[ShapedHand]) -> None:
        """Overwrite lengths and normals, in place, with those of hands of other shapes."""
        for name in ("local_vertices", "local_normals", "bone_origins", "tip_offsets"):
            values = np.stack([getattr(hand, name) for hand in hands]).astype(np.float32)
            if name in ("local_vertices", "local_normals"):
                values = np.ascontiguousarray(values[:, self.kept])
            getattr(self, name).assign(values)

    @classmethod
    def upload(
        cls,
        hands: Sequence[ShapedHand],
        device: wp.Device,
        *,
        vertices: NDArray[np.intp] | None = None,
    ) -> DeviceHand:
        """Copy hands to a device.

        Args:
            hands: Hands of one side, shape (nhand,); topology, weights and limits are shared.
            device: Where to.
            vertices: Numbers of the vertices to keep, in this order; all when None. Triangles
                always name all vertices.
        """
        first = hands[0]
        kept = np.arange(first.nvert) if vertices is None else np.asarray(vertices)
        fingers = np.array([finger_of_bone(b) for b in range(NBONE)])
        used = np.where(first.weights > 0, fingers[first.weight_bones], -1)[kept]

        def stack(name: str, dtype: type, rows: NDArray[np.intp] | None = None) -> wp.array:
            values = np.stack([getattr(hand, name) for hand in hands]).astype(np.float32)
            values = values if rows is None else np.ascontiguousarray(values[:, rows])
            return wp.array(values, dtype=dtype, device=device)

        def put(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        return cls(
            faces=put(first.faces.astype(np.int32), int),
            weight_bones=put(first.weight_bones[kept].astype(np.int32), int),
            weights=put(first.weights[kept].astype(np.float32), float),
            local_vertices=stack("local_vertices", wp.vec3, kept),
            local_normals=stack("local_normals", wp.vec3, kept),
            bone_rotations=stack("bone_rotations", wp.mat33),
            bone_origins=stack("bone_origins", wp.vec3),
            angle_axes=stack("angle_axes", wp.vec3),
            bone_parents=put(np.array(BONE_PARENTS, np.int32), int),
            bone_angles=put(BONE_ANGLES, int),
            angle_bones=put(np.array(ANGLE_BONES, np.int32), int),
            vertex_chains=put(used.max(axis=1).astype(np.int32), int),
            vertex_is_hand=put((~first.stub_vertices)[kept].astype(np.int32), int),
            limits=put(first.limits.astype(np.float32), float),
            tip_offsets=stack("tip_offsets", wp.vec3),
            kept=kept,
        )
