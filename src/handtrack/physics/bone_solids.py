"""Each bone as a rigid solid made from the skin: convex collision pieces, mass and inertia.

Skinning bends the flesh; a simulation of rigid bodies needs one solid per bone. The pieces are the
convex hulls of the skin that a bone moves, which lie on the skin where fingers touch things.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, KDTree

from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.side import MIRROR, mirror_points
from handtrack.hand.skeleton import BASE_BONES, NBONE

Float = NDArray[np.float64]

FLESH_DENSITY = 1100.0
"""Density of a hand [kg/m^3]: Clauser, McConville and Young 1969 found 1.1 to 1.16 g/cm^3."""

VOXEL = 0.0025
"""Spacing of the points that sample the flesh for mass and inertia [m]."""

PALM_CUTS = (0.35, 0.7)
"""Where the palm's pieces end, as shares of its length: one hull would bridge its hollow."""

PIECE_OVERLAP = 0.08
"""How far neighbouring pieces of a bone overlap, as a share of its length."""

WEBBED_BONES = (2, 4, 7, 10, 13)
"""Bones with webs of skin at their root, cut in two: one hull would bridge the hollow beside it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneSolid:
    """One bone as a rigid body. Metres and kilograms, in the bone's frame."""

    pieces: tuple[Float, ...]
    """Corners of the convex collision pieces, each of shape (n, 3)."""
    mass: float
    centre: Float
    """Centre of mass, shape (3,)."""
    inertia: Float
    """Inertia about the centre of mass [kg m^2], shape (3, 3)."""


def bone_solids(hand: ShapedHand, *, density: float = FLESH_DENSITY) -> tuple[BoneSolid, ...]:
    """The 16 solids of one hand, which together weigh what its skin encloses.

    Args:
        hand: One person's hand.
        density: Density of the flesh [kg/m^3].
    """
    if hand.side == "left":
        return tuple(_mirrored(solid) for solid in bone_solids(hand.as_right(), density=density))
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    rotations, origins = bone_frames(hand, pose)
    vertices = skin(hand, pose)
    points, bones = _flesh(hand, vertices)
    # The grid is coarse beside a fingertip: the total is set right by the enclosed volume.
    weight = density * _volume(vertices, hand.faces) / len(points)
    solids = []
    for bone in range(NBONE):
        own = (points[bones == bone] - origins[bone]) @ rotations[bone]
        mass, centre, inertia = _mass_properties(own, weight)
        solids.append(
            BoneSolid(pieces=_pieces(hand, bone), mass=mass, centre=centre, inertia=inertia)
        )
    return tuple(solids)


def _mirrored(solid: BoneSolid) -> BoneSolid:
    """The same bone of the other hand."""
    return BoneSolid(
        pieces=tuple(mirror_points(piece) for piece in solid.pieces),
        mass=solid.mass,
        centre=mirror_points(solid.centre),
        inertia=solid.inertia * np.outer(MIRROR, MIRROR),
    )


def _own_skin(hand: ShapedHand, bone: int) -> Float:
    """Vertices that move mainly with a bone [m], in its frame, shape (n, 3)."""
    main = np.arange(hand.nvert), hand.weights.argmax(1)
    return hand.local_vertices[main][hand.weight_bones[main] == bone]


def _pieces(hand: ShapedHand, bone: int) -> tuple[Float, ...]:
    skin_points = _own_skin(hand, bone)
    if bone in WEBBED_BONES:
        share = skin_points[:, 0] / hand.bone_lengths[bone]
        halves = (share < 0.5 + PIECE_OVERLAP, share > 0.5 - PIECE_OVERLAP)
        return tuple(hull_corners(skin_points[half]) for half in halves)
    if bone != 0:
        return (hull_corners(skin_points),)
    # Strips along the metacarpals of the four fingers, cut across: the palm is hollow both ways.
    rays = hand.bone_origins[list(BASE_BONES[1:])]
    spread = np.clip(skin_points[:, :1] / rays[:, 0], 0.3, 1.0) * rays[:, 2]
    lanes = np.argmin(np.abs(skin_points[:, 2:] - spread), axis=1)
    along = skin_points[:, 0] / hand.bone_lengths[0]
    pieces = []
    edges = (-np.inf, 0.0, *PALM_CUTS, np.inf)
    for low, high in pairwise(edges):
        row = (along >= low - PIECE_OVERLAP) & (along < high + PIECE_OVERLAP)
        groups = [row] if high <= PALM_CUTS[0] else [row & (lanes == lane) for lane in range(4)]
        pieces += [hull_corners(skin_points[group]) for group in groups if group.sum() >= 8]
    return tuple(pieces)


def hull_corners(points: Float) -> Float:
    """Corners of the convex hull of points [m], shape (n, 3)."""
    return points[ConvexHull(points).vertices]


def _volume(vertices: Float, faces: NDArray) -> float:
    """Volume that a closed mesh encloses [m^3], by the divergence theorem."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def _flesh(hand: ShapedHand, vertices: Float) -> tuple[Float, NDArray[np.int64]]:
    """Points on a grid inside the skin [m], shape (n, 3), and the bone of each, shape (n,)."""
    low, high = vertices.min(0), vertices.max(0)
    axes = [np.arange(a + 0.5 * VOXEL, b, VOXEL) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    corners = vertices[hand.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middles = corners.mean(1)
    near = np.asarray(KDTree(middles).query(grid)[1])
    inside = np.einsum("ni,ni->n", grid - middles[near], normals[near]) < 0.0
    vertex = hand.faces[near[inside], 0]
    main = hand.weights[vertex].argmax(1)
    return grid[inside], hand.weight_bones[vertex, main].astype(np.int64)


def _mass_properties(points: Float, weight: float) -> tuple[float, Float, Float]:
    """Mass [kg], centre [m] and inertia [kg m^2] of equal small cubes of `weight` [kg]."""
    centre = points.mean(0)
    arm = points - centre
    second = weight * arm.T @ arm
    inertia = np.trace(second) * np.eye(3) - second
    # A cube's own inertia, so that a thin bone keeps three positive moments.
    inertia += np.eye(3) * weight * len(points) * VOXEL**2 / 6.0
    return weight * len(points), centre, inertia
