"""The unknowns of a hand's shape, and how the hand changes with them (Eq. II.3 to II.7).

They are log(scale), alpha, beta, in this order. Local vertices and joint origins are products of
a part linear in beta and a stretch linear in alpha, so their derivatives are exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.model import HandModel, ShapedHand, skeleton_frames
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, check_side, mirror_points
from handtrack.hand.skeleton import BASE_BONES, BONE_PARENTS, DISTAL_BONES, NBONE

Float = NDArray[np.float64]


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
        rotations, origins = skeleton_frames(
            model.bone_rotations, model.bone_origins, model.dof_axes, model.rest_angles
        )
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
        model, nalpha = self.model, self.model.nalpha
        first = 1 + nalpha
        beta = x[first:]
        scales = model.scale_mean + model.scale_basis @ x[1:first]
        size = np.exp(x[0])
        # Stretch of each bone along x and across, and its derivatives by log(scale) and alpha.
        stretch = np.full((NBONE, 3), size * scales[0])
        stretch[:, 0] *= scales[1:]
        grow = np.zeros((NBONE, first, 3))
        grow[:, 0] = stretch
        grow[:, 1:] = size * model.scale_basis[0][None, :, None]
        grow[:, 1:, 0] = size * (
            scales[1:, None] * model.scale_basis[0] + scales[0] * model.scale_basis[1:]
        )

        bones = model.weight_bones
        local = self._base + np.einsum("vkbi,b->vki", self._turned, beta)
        vertices = np.empty((*bones.shape, self.count, 3))
        vertices[:, :, :first] = local[:, :, None] * grow[bones]
        vertices[:, :, first:] = self._turned * stretch[bones][:, :, None]

        count, bases = len(model.vertices), list(BASE_BONES)
        joints = model.bone_origins.copy()
        joints[bases] += model.offset_mean[count:] + model.offset_basis[count:] @ beta
        parents = list(BONE_PARENTS[1:])
        joint_steps = np.zeros((NBONE, self.count, 3))
        joint_steps[1:, :first] = joints[1:, None] * grow[parents]
        # The joints at the fingers' roots sit in the palm.
        joint_steps[bases, first:] = np.swapaxes(model.offset_basis[count:], 1, 2) * stretch[0]
        tip_steps = np.zeros((len(DISTAL_BONES), self.count, 3))
        tip_steps[:, :first] = model.tip_offsets[:, None] * grow[list(DISTAL_BONES)]
        if self.side == "left":
            vertices, joint_steps, tip_steps = map(
                mirror_points, (vertices, joint_steps, tip_steps)
            )
        return ShapeSteps(vertices=vertices, joints=joint_steps, tips=tip_steps)

    def length_steps(self, x: Float) -> Float:
        """Derivatives of the 16 bone lengths [m], shape (16, nshape)."""
        hand, steps = self.hand(x), self.steps(x)
        found = np.empty((NBONE, self.count))
        middle = BASE_BONES[2]
        ends = {0: (hand.bone_origins[middle], steps.joints[middle])}
        for bone, parent in enumerate(BONE_PARENTS):
            if parent > 0:
                ends[parent] = (hand.bone_origins[bone], steps.joints[bone])
        for finger, bone in enumerate(DISTAL_BONES):
            ends[bone] = (hand.tip_offsets[finger], steps.tips[finger])
        for bone, (end, step) in ends.items():
            found[bone] = step @ end / np.linalg.norm(end)
        return found
