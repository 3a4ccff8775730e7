"""The unknowns of a hand's shape, and how the hand changes with them (Eq. II.3 to II.7).

They are log(scale), alpha, beta, in this order. Local vertices and joint origins are products of
a part linear in beta and a stretch linear in alpha, so their derivatives are exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, check_side, mirror_points
from handtrack.hand.skeleton import BASE_BONES, BONE_PARENTS, DISTAL_BONES, NBONE

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Skeleton:
    """Joints and fingertips of a right hand, and their derivatives."""

    stretch: Float
    """Stretch of each bone along x and across, shape (16, 3)."""
    grow: Float
    """Its derivatives by log(scale) and alpha, shape (16, 1 + nalpha, 3)."""
    joints: Float
    """Joint origins in their parents' frames [m], shape (16, 3)."""
    joint_steps: Float
    """Their derivatives, shape (16, nshape, 3)."""
    tips: Float
    """Fingertips in the distal bones' frames [m], shape (5, 3)."""
    tip_steps: Float
    """Their derivatives, shape (5, nshape, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeSteps:
    """Derivatives of a hand by the unknowns of its shape."""

    vertices: Float
    """Of the local vertices [m], shape (nvert, 3, nshape, 3)."""
    joints: Float
    """Of the joint origins in their parents' frames [m], shape (16, nshape, 3)."""
    tips: Float
    """Of the fingertips in the distal bones' frames [m], shape (5, nshape, 3)."""


class ShapeUnknowns:
    """Turns vectors of unknowns into shapes and hands of one side."""

    def __init__(self, model: HandModel, *, side: str = "right") -> None:
        """Prepare what does not change with the shape.

        Args:
            model: The parametric hand.
            side: "right" or "left".
        """
        self.model = model
        self.side: Side = check_side(side)
        self.count = 1 + model.nalpha + model.nbeta
        count = len(model.vertices)
        rotations, origins = model.rest_skeleton()
        bones = model.weight_bones
        base = model.vertices[:, None] - origins[bones] + model.offset_mean[:count, None]
        self._base = np.einsum("vkji,vkj->vki", rotations[bones], base)
        self._turned = np.einsum("vkji,vjb->vkbi", rotations[bones], model.offset_basis[:count])

    def vector(self, shape: HandShape) -> Float:
        """Unknowns of a shape, shape (nshape,)."""
        x = np.zeros(self.count)
        x[0] = np.log(shape.scale)
        x[1 : 1 + len(shape.alpha)] = shape.alpha
        first = 1 + self.model.nalpha
        x[first : first + len(shape.beta)] = shape.beta
        return x

    def shape(self, x: Float) -> HandShape:
        """Shape of unknowns, shape (nshape,)."""
        nalpha = self.model.nalpha
        return HandShape(scale=float(np.exp(x[0])), alpha=x[1 : 1 + nalpha], beta=x[1 + nalpha :])

    def with_deviations(self, shape: HandShape, deviations: Float) -> HandShape:
        """A shape that tells how sure it is.

        Args:
            shape: The shape.
            deviations: One sigma of each unknown, shape (nshape,).
        """
        first = 1 + self.model.nalpha
        return replace(
            shape, scale_std=float(shape.scale * deviations[0]),
            alpha_std=deviations[1:first], beta_std=deviations[first:],
        )  # fmt: skip

    def hand(self, x: Float) -> ShapedHand:
        """Hand of unknowns, shape (nshape,)."""
        return self.model.shaped(self.shape(x), side=self.side)

    def steps(self, x: Float) -> ShapeSteps:
        """Derivatives at unknowns, shape (nshape,)."""
        skeleton, bones = self._skeleton(x), self.model.weight_bones
        first = 1 + self.model.nalpha
        local = self._base + np.einsum("vkbi,b->vki", self._turned, x[first:])
        vertices = np.empty((*bones.shape, self.count, 3))
        vertices[:, :, :first] = local[:, :, None] * skeleton.grow[bones]
        vertices[:, :, first:] = self._turned * skeleton.stretch[bones][:, :, None]
        found = vertices, skeleton.joint_steps, skeleton.tip_steps
        if self.side == "left":
            found = tuple(map(mirror_points, found))
        return ShapeSteps(vertices=found[0], joints=found[1], tips=found[2])

    def length_steps(self, x: Float) -> Float:
        """Derivatives of the 16 bone lengths [m], shape (16, nshape)."""
        skeleton = self._skeleton(x)
        found = np.empty((NBONE, self.count))
        middle = BASE_BONES[2]
        ends = {0: (skeleton.joints[middle], skeleton.joint_steps[middle])}
        for bone, parent in enumerate(BONE_PARENTS):
            if parent > 0:
                ends[parent] = (skeleton.joints[bone], skeleton.joint_steps[bone])
        for finger, bone in enumerate(DISTAL_BONES):
            ends[bone] = (skeleton.tips[finger], skeleton.tip_steps[finger])
        for bone, (end, step) in ends.items():
            found[bone] = step @ end / np.linalg.norm(end)
        return found

    def _skeleton(self, x: Float) -> _Skeleton:
        """Joints and fingertips at unknowns, shape (nshape,)."""
        model, first = self.model, 1 + self.model.nalpha
        scales = model.scale_mean + model.scale_basis @ x[1:first]
        size = np.exp(x[0])
        stretch = np.full((NBONE, 3), size * scales[0])
        stretch[:, 0] *= scales[1:]
        grow = np.zeros((NBONE, first, 3))
        grow[:, 0] = stretch
        grow[:, 1:] = size * model.scale_basis[0][None, :, None]
        grow[:, 1:, 0] = size * (
            scales[1:, None] * model.scale_basis[0] + scales[0] * model.scale_basis[1:]
        )

        count, bases, parents = len(model.vertices), list(BASE_BONES), list(BONE_PARENTS[1:])
        joints = model.bone_origins.copy()
        joints[bases] += model.offset_mean[count:] + model.offset_basis[count:] @ x[first:]
        joint_steps = np.zeros((NBONE, self.count, 3))
        joint_steps[1:, :first] = joints[1:, None] * grow[parents]
        # The joints at the fingers' roots sit in the palm.
        joint_steps[bases, first:] = np.swapaxes(model.offset_basis[count:], 1, 2) * stretch[0]
        joints[1:] *= stretch[parents]
        distal = list(DISTAL_BONES)
        tip_steps = np.zeros((len(distal), self.count, 3))
        tip_steps[:, :first] = model.tip_offsets[:, None] * grow[distal]
        return _Skeleton(
            stretch=stretch, grow=grow, joints=joints, joint_steps=joint_steps,
            tips=model.tip_offsets * stretch[distal], tip_steps=tip_steps,
        )  # fmt: skip
