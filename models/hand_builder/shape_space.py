"""Shape space of the hand (thesis Eq. II.1 to II.9): scales and offsets of subjects, their PCA."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hand_builder.skeleton import Skeleton, bone_lengths, bone_origins, fit_pose
from hand_builder.subjects import HandSubject
from handtrack.hand.learning.shape_bases import principal_components
from handtrack.hand.model import skeleton_frames
from handtrack.hand.skeleton import BASE_BONES, BONE_PARENTS, DISTAL_BONES, NBONE

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """The template hand with its skeleton and weights."""

    vertices: Float
    """Shape (nvert, 3), palm frame [m]."""
    skeleton: Skeleton
    bone_origins: Float
    tip_offsets: Float
    lengths: Float
    """Bone lengths [m], shape (16,)."""
    weight_bones: NDArray[np.int32]
    weights: Float

    def rest_frames(self) -> tuple[Float, Float]:
        """Rotations, shape (16, 3, 3), and origins, shape (16, 3), of the bones at rest."""
        s = self.skeleton
        return skeleton_frames(s.bone_rotations, self.bone_origins, s.dof_axes, s.rest_angles)


def make_template(
    hand: HandSubject, skeleton: Skeleton, weight_bones: NDArray[np.int32], weights: Float
) -> Template:
    """Template from the subject whose keypoints defined the skeleton."""
    origins, tips = bone_origins(hand.keypoints)
    return Template(
        vertices=hand.vertices,
        skeleton=skeleton,
        bone_origins=origins,
        tip_offsets=tips,
        lengths=bone_lengths(hand.keypoints),
        weight_bones=weight_bones,
        weights=weights,
    )


def stretches(scales: Float) -> Float:
    """Factors along x, y, z of each bone, shape (16, 3), for S = [s_g, s_0..s_15] (Eq. II.3)."""
    out = np.full((NBONE, 3), scales[0])
    out[:, 0] *= scales[1:]
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """A subject in terms of the template."""

    scales: Float
    """S, shape (17,)."""
    offsets: Float
    """Q of the vertices and then of the five base joints [m], shape (nvert + 5, 3)."""
    angles: Float
    """Joint angles of the subject's own rest pose [rad], shape (21,)."""


def encode(template: Template, subject: HandSubject) -> Encoding:
    """Finds S, Q and rest angles with which Eq. II.9 reproduces the subject's mesh exactly.

    s_g is the ratio of summed bone lengths and each s_j what is left of its bone's ratio; the
    offset of a vertex solves a linear system of three equations:
    sum_j w_ij (R_j D_j (v_ij + R_j(rest)^T Q_i) + o_j) = v_i, where D_j stretches bone j.
    """
    skeleton = template.skeleton
    ratios = bone_lengths(subject.keypoints) / template.lengths
    overall = bone_lengths(subject.keypoints).sum() / template.lengths.sum()
    scales = np.concatenate([[overall], ratios / overall])
    stretch = stretches(scales)

    base = list(BASE_BONES)
    marks = [1 + 4 * f for f in range(5)]
    base_offsets = subject.keypoints[marks] / stretch[0] - template.bone_origins[base]
    origins = template.bone_origins.copy()
    origins[base] += base_offsets
    origins[1:] *= stretch[list(BONE_PARENTS[1:])]
    angles = fit_pose(subject.keypoints, skeleton.bone_rotations)
    turned, placed = skeleton_frames(skeleton.bone_rotations, origins, skeleton.dof_axes, angles)
    rest_turned, rest_placed = template.rest_frames()

    bones, weights = template.weight_bones, template.weights
    local = np.einsum(
        "vkji,vkj->vki", rest_turned[bones], template.vertices[:, None] - rest_placed[bones]
    )
    push = turned[bones] * stretch[bones][:, :, None, :]
    constant = np.einsum(
        "vk,vki->vi", weights, np.einsum("vkij,vkj->vki", push, local) + placed[bones]
    )
    matrix = np.einsum("vk,vkij,vklj->vil", weights, push, rest_turned[bones])
    vertex_offsets = np.linalg.solve(matrix, (subject.vertices - constant)[..., None])[..., 0]
    return Encoding(scales=scales, offsets=np.vstack([vertex_offsets, base_offsets]), angles=angles)


def decode(template: Template, scales: Float, offsets: Float, angles: Float) -> HandSubject:
    """The hand of Eq. II.9 in the palm frame, from what `Encoding` holds."""
    skeleton = template.skeleton
    stretch = stretches(scales)
    nvert = len(template.vertices)
    origins = template.bone_origins.copy()
    origins[list(BASE_BONES)] += offsets[nvert:]
    origins[1:] *= stretch[list(BONE_PARENTS[1:])]
    turned, placed = skeleton_frames(skeleton.bone_rotations, origins, skeleton.dof_axes, angles)
    rest_turned, rest_placed = template.rest_frames()
    bones = template.weight_bones
    moved = template.vertices[:, None] - rest_placed[bones] + offsets[:nvert, None]
    local = np.einsum("vkji,vkj->vki", rest_turned[bones], moved) * stretch[bones]
    points = np.einsum("vkij,vkj->vki", turned[bones], local) + placed[bones]
    vertices = np.einsum("vk,vki->vi", template.weights, points)

    keypoints = np.zeros((21, 3))
    tips = template.tip_offsets * stretch[list(DISTAL_BONES)]
    for finger in range(5):
        chain = [1 + 3 * finger, 2 + 3 * finger, 3 + 3 * finger]
        keypoints[1 + 4 * finger : 4 + 4 * finger] = placed[chain]
        keypoints[4 + 4 * finger] = placed[chain[2]] + turned[chain[2]] @ tips[finger]
    return HandSubject(vertices=vertices, keypoints=keypoints)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearSpace:
    """Mean and basis of a PCA whose coordinates have unit variance over the population."""

    mean: Float
    """Shape (d,)."""
    basis: Float
    """Columns are components times standard deviation, shape (d, n)."""
    variance: Float
    """Explained share of the total variance of each component, shape (n,)."""
    weights: Float
    """Unit in which entries are compared, shape (d,)."""

    def project(self, value: Float) -> Float:
        """Coordinates of the nearest point of the space, shape (n,)."""
        target = (value - self.mean) * self.weights
        return np.linalg.lstsq(self.basis * self.weights[:, None], target, rcond=None)[0]

    def truncated(self, count: int) -> LinearSpace:
        """The space of the first `count` components."""
        return replace(self, basis=self.basis[:, :count], variance=self.variance[:count])


def scale_weights(template: Template) -> Float:
    """What one unit of each entry of S is in metres, shape (17,): PCA then compares like with like.

    A bone's scale counts by the bone's length; the overall scale, which moves every vertex, by the
    root mean square distance of the vertices from the wrist.
    """
    reach = np.sqrt((template.vertices**2).sum(axis=1).mean())
    return np.concatenate([[reach], template.lengths])


def principal_space(samples: Float, *, share: float, weights: Float | None = None) -> LinearSpace:
    """PCA with as many components as explain a share of the variance.

    Args:
        samples: Shape (n, d).
        share: Share of the total variance to explain.
        weights: Unit of each entry for the purpose of comparing variances, shape (d,); all one when
            None.

    Returns:
        Mean, basis and explained shares.
    """
    weights = np.ones(samples.shape[1]) if weights is None else weights
    mean, basis, variance = principal_components(samples, weights, share)
    return LinearSpace(mean=mean, basis=basis, variance=variance, weights=weights)
