"""The template in the shape and poses of one subject, and how it changes with everything learnt.

This is Eq. II.9 of the thesis with free bone stretches and offsets in place of shape coordinates.
At fixed poses the vertices are linear in the stretches of the bones, in the offsets and in the
weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.inverse_kinematics import BonePoints, point_jacobian
from handtrack.hand.kinematics import bone_frames, skin_of_frames
from handtrack.hand.model import HandModel, ShapedHand, vertex_normals
from handtrack.hand.skeleton import BONE_PARENTS, NBONE, NV, finger_of_bone

Float = NDArray[np.float64]

FINGER_OF_BONE = np.array([finger_of_bone(bone) for bone in range(NBONE)])
"""Finger of each bone, -1 for the palm, shape (16,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectShape:
    """Bone stretches and offsets of one subject, not yet confined to a shape space."""

    stretches: Float
    """Length of each bone over the template's, s_g s_j of Eq. II.2, shape (16,)."""
    joints: Float
    """Offsets of the five base joints [m], shape (5, 3)."""
    offsets: Float
    """Offsets Q of the vertices [m], template at rest, shape (nvert, 3)."""

    @property
    def all_offsets(self) -> Float:
        """Offsets of vertices and base joints [m], as `HandModel` stacks them."""
        return np.vstack([self.offsets, self.joints])


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """The model whose template and weights are in use, and what follows from them once."""

    model: HandModel
    lengths: Float
    """Bone lengths [m], shape (16,)."""
    rest_rotations: Float
    """Rotations of the bones at rest, palm frame, shape (16, 3, 3)."""
    rest_origins: Float
    """Origins of the bones at rest [m], palm frame, shape (16, 3)."""
    stub: NDArray[np.bool_]
    """Vertices of the arm behind the wrist, shape (nvert,)."""

    @classmethod
    def of(cls, model: HandModel) -> Template:
        """Template of a model; its shape space is not used."""
        plain = replace(
            model,
            scale_mean=np.ones(NBONE + 1),
            scale_basis=np.zeros((NBONE + 1, 0)),
            offset_mean=np.zeros((len(model.vertices) + 5, 3)),
            offset_basis=np.zeros((len(model.vertices) + 5, 3, 0)),
        )
        rotations, origins = model.rest_skeleton()
        hand = plain.shaped()
        return cls(
            model=plain,
            lengths=hand.bone_lengths,
            stub=hand.stub_vertices,
            rest_rotations=rotations,
            rest_origins=origins,
        )

    def with_weights(self, bones: NDArray[np.int32], weights: Float) -> Template:
        """The same template with other skinning weights."""
        return replace(self, model=replace(self.model, weight_bones=bones, weights=weights))

    def shape(self, size: float = 1.0) -> SubjectShape:
        """The template's own shape, `size` times as large."""
        return SubjectShape(
            stretches=np.full(NBONE, size),
            joints=np.zeros((5, 3)),
            offsets=np.zeros_like(self.model.vertices),
        )

    def overall(self, shape: SubjectShape) -> float:
        """s_g: summed bone lengths over the template's.

        Nothing but the split into s_g and s_j hangs on this choice; it is that of `hand.npz`.
        """
        return float(shape.stretches @ self.lengths / self.lengths.sum())

    def scales(self, shape: SubjectShape) -> Float:
        """S of Eq. II.2: s_g, then s_j, shape (17,)."""
        overall = self.overall(shape)
        return np.concatenate([[overall], shape.stretches / overall])

    def hand(self, shape: SubjectShape) -> ShapedHand:
        """The template's weights and skeleton in a subject's shape."""
        return replace(
            self.model, scale_mean=self.scales(shape), offset_mean=shape.all_offsets
        ).shaped()


class PosedTemplate:
    """One subject's hand in the poses of all its scans; derivatives are computed when asked for."""

    def __init__(self, template: Template, shape: SubjectShape, poses: Float) -> None:
        self._template = template
        self._shape = shape
        self._poses = poses
        self._overall = template.overall(shape)
        self._hand = template.hand(shape)
        self._rotations, self._origins = bone_frames(self._hand, poses)
        self.vertices: Float = skin_of_frames(self._hand, self._rotations, self._origins)
        """Vertices [m], shape (npose, nvert, 3)."""

    @cached_property
    def normals(self) -> Float:
        """Unit normals of the posed meshes, shape (npose, nvert, 3)."""
        return np.stack([vertex_normals(mesh, self._hand.faces) for mesh in self.vertices])

    def by_pose(self) -> Float:
        """Derivative by the pose's increment, shape (npose, nvert, 3, 27)."""
        hand = self._hand
        vertex, slot = np.nonzero(hand.weights > 0)
        points = BonePoints(
            bones=hand.weight_bones[vertex, slot].astype(np.int64),
            offsets=hand.local_vertices[vertex, slot],
        )
        starts = np.searchsorted(vertex, np.arange(hand.nvert))
        out = np.empty((*self.vertices.shape, NV))
        for index, pose in enumerate(self._poses):  # one at a time bounds the memory
            jacobian = point_jacobian(hand, points, pose[None])[1][0]
            jacobian *= hand.weights[vertex, slot][:, None, None]
            out[index] = np.add.reduceat(jacobian, starts, axis=0)
        return out

    def by_stretches(self) -> Float:
        """Derivative by the bones' stretches, shape (npose, nvert, 3, 16).

        The overall scale, which moves everything across the bones, follows from the stretches.
        """
        hand, stretches = self._hand, self._shape.stretches
        # Column 0 stands for the overall scale until the end.
        origins = np.zeros((len(self._poses), NBONE, 3, NBONE + 1))
        for bone, parent in enumerate(BONE_PARENTS):
            if parent < 0:
                continue
            turn, place = self._rotations[:, parent], hand.bone_origins[bone]
            origins[:, bone] = origins[:, parent]
            origins[:, bone, :, 0] += turn[:, :, 1:] @ place[1:] / self._overall
            origins[:, bone, :, 1 + parent] += turn[:, :, 0] * place[0] / stretches[parent]
        out = np.zeros((*self.vertices.shape, NBONE + 1))
        for slot in range(hand.weights.shape[1]):
            bones, local = hand.weight_bones[:, slot], hand.local_vertices[:, slot]
            weights = hand.weights[:, slot]
            turn = self._rotations[:, bones]
            out += weights[:, None, None] * origins[:, bones]
            across = np.einsum("tvij,vj->tvi", turn[..., 1:], local[:, 1:]) / self._overall
            out[..., 0] += weights[:, None] * across
            along = turn[..., 0] * (weights * local[:, 0] / stretches[bones])[:, None]
            out[:, np.arange(hand.nvert), :, 1 + bones] += np.swapaxes(along, 0, 1)
        lengths = self._template.lengths
        return out[..., 1:] + out[..., :1] * (lengths / lengths.sum())

    def by_joints(self) -> Float:
        """Derivative by the offsets of the base joints, shape (npose, nvert, 3, 15)."""
        hand = self._hand
        stretch = np.array([self._shape.stretches[0], self._overall, self._overall])
        palm = self._rotations[:, 0] * stretch
        out = np.empty((*self.vertices.shape, 5, 3))
        for finger in range(5):
            share = (hand.weights * (FINGER_OF_BONE[hand.weight_bones] == finger)).sum(axis=1)
            out[..., finger, :] = share[:, None, None] * palm[:, None]
        return out.reshape(*self.vertices.shape, 15)

    def by_offsets(self) -> Float:
        """Derivative of each vertex by its own offset, shape (npose, nvert, 3, 3)."""
        hand = self._hand
        return np.einsum("vk,tvkij->tvij", hand.weights, self._push()[:, hand.weight_bones])

    def by_weights(self, bones: NDArray[np.intp]) -> Float:
        """Where single bones would put each vertex [m]: its derivative by their weights.

        Args:
            bones: Bones to try for each vertex, shape (nvert, n).

        Returns:
            Points [m], shape (npose, nvert, n, 3).
        """
        push = self._push()
        shift = self._origins - np.einsum("tbij,bj->tbi", push, self._template.rest_origins)
        moved = self._template.model.vertices + self._shape.offsets
        return np.einsum("tvkij,vj->tvki", push[:, bones], moved) + shift[:, bones]

    def _push(self) -> Float:
        """What each bone does to a direction of the resting template, shape (npose, 16, 3, 3)."""
        stretch = np.full((NBONE, 3), self._overall)
        stretch[:, 0] = self._shape.stretches
        turned = self._rotations * stretch[:, None, :]
        return turned @ np.swapaxes(self._template.rest_rotations, 1, 2)
