"""Where forests look: points sampled in space and tied to the nearest vertex (II.4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from handtrack.forest.config import ForestConfig
from handtrack.hand.kinematics import bone_frames, skin, skin_normals
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import BASE_BONES

ANCHORS = 320
"""Vertices that points can hang on, spread evenly over the skin."""

PALM_BOX = np.array([[-0.07, -0.09, -0.12], [0.21, 0.11, 0.12]])
"""Corners of the box around the hand in which points of palm and hand lie, palm frame [m]."""

FINGER_BOX = np.array([[-0.05, -0.05, -0.05], [0.13, 0.11, 0.05]])
"""Corners of the box around a finger's root, root frame [m]."""

NEAR_SHARE = 0.6
"""Share of points that lie near the skin; the others are anywhere in the box."""

NEAR_SPREAD = 0.015
"""Deviation of the near points from the skin along and across it [m]."""

Float = NDArray[np.float64]


def spread_vertices(hand: ShapedHand, count: int = ANCHORS) -> NDArray[np.int32]:
    """Vertices spread evenly over the hand without its forearm stub, shape (count,)."""
    points = skin(hand, _open_pose(hand))
    allowed = np.flatnonzero(~hand.stub_vertices)
    chosen = [int(allowed[0])]
    distance = np.full(len(allowed), np.inf)
    for _ in range(min(count, len(allowed)) - 1):
        gap = np.linalg.norm(points[allowed] - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, gap)
        chosen.append(int(allowed[np.argmax(distance)]))
    return np.array(chosen, np.int32)


def draw_points(
    hand: ShapedHand,
    anchor_vertices: NDArray[np.int32],
    part: int,
    config: ForestConfig,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Reference points of one part.

    Args:
        hand: The mean hand.
        anchor_vertices: Vertices that points can hang on, shape (nanchor,).
        part: -1 for palm or hand, else the finger.
        config: How many points, and whether they hang on vertices.
        rng: Source of the random numbers.

    Returns:
        Anchor of each point, -1 for the frame's origin, shape (npoint,), and offsets in the part's
        frame [m], shape (npoint, 3). Point 0 stands for the part's own depth.
    """
    pose = _open_pose(hand)
    rotations, origins = bone_frames(hand, pose)
    bone = 0 if part < 0 else BASE_BONES[part]
    vertices = (skin(hand, pose) - origins[bone]) @ rotations[bone]
    normals = skin_normals(hand, pose) @ rotations[bone]
    low, high = PALM_BOX if part < 0 else FINGER_BOX
    inside = np.flatnonzero(((vertices > low) & (vertices < high)).all(axis=1))
    near = round(NEAR_SHARE * config.points)
    chosen = rng.choice(inside, near)
    points = np.concatenate([
        vertices[chosen] + normals[chosen] * rng.normal(0, NEAR_SPREAD, (near, 1))
        + rng.normal(0, NEAR_SPREAD, (near, 3)),
        rng.uniform(low, high, (config.points - near, 3)),
    ])  # fmt: skip
    if config.features == "pose-indexed":
        return np.full(config.points, -1, np.int32), points.astype(np.float32)
    anchors = np.asarray(KDTree(vertices[anchor_vertices]).query(points)[1])
    offsets = points - vertices[anchor_vertices[anchors]]
    return anchors.astype(np.int32), offsets.astype(np.float32)


def _open_pose(hand: ShapedHand) -> Float:
    """The hand at its start angles, unturned, shape (28,)."""
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    return pose
