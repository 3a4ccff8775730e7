"""A forearm for synthesised hands: a tapered tube to the elbow, free to bend at the wrist.

The tracker's model has only a stub of forearm, rigid with the palm; people's wrists bend, so frames
made for measuring must show a forearm that the model cannot explain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.hand.model import ShapedHand

RINGS = 14
SEGMENTS = 24

GROWTH = 1.5
"""Thickness near the elbow over thickness at the wrist."""


def forearm_faces(first_vertex: int) -> NDArray[np.int32]:
    """Outward triangles of tube and caps, shape (nface, 3), for vertices from `first_vertex`."""
    faces = []
    for ring in range(RINGS - 1):
        for k in range(SEGMENTS):
            a, b = ring * SEGMENTS + k, ring * SEGMENTS + (k + 1) % SEGMENTS
            c, d = a + SEGMENTS, b + SEGMENTS
            faces += [[a, c, b], [b, c, d]]
    last = (RINGS - 1) * SEGMENTS
    for k in range(1, SEGMENTS - 1):
        faces += [[0, k, k + 1], [last, last + k + 1, last + k]]
    return np.array(faces, np.int32) + first_vertex


def wrist_section(hand: ShapedHand) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middle and half axes (y, z) [m] of the wrist's section, palm frame, shape (2,) each."""
    # Palm-bone coordinates are palm-frame coordinates.
    slot = (hand.weight_bones == 0) & (hand.weights > 0)
    palm = hand.local_vertices[slot]
    ring = palm[(palm[:, 0] < 0.3 * hand.cut_x) & (palm[:, 0] > 0.9 * hand.cut_x)][:, 1:]
    low, high = ring.min(0), ring.max(0)
    return 0.5 * (low + high), 0.5 * (high - low)


def forearm_vertices(
    hand: ShapedHand, rotation: ArrayLike, origin: ArrayLike, elbow: ArrayLike
) -> NDArray[np.float64]:
    """Vertices of the forearm [m], shape (RINGS * SEGMENTS, 3), camera frame.

    Args:
        hand: The hand it belongs to; gives the wrist's thickness.
        rotation: R_camera_palm, shape (3, 3).
        origin: Wrist [m], camera frame, shape (3,).
        elbow: Elbow [m], camera frame, shape (3,).
    """
    rotation = np.asarray(rotation, np.float64)
    origin, elbow = np.asarray(origin, np.float64), np.asarray(elbow, np.float64)
    middle, half = wrist_section(hand)
    length = np.linalg.norm(elbow - origin)
    # The tube leaves the wrist along the palm and bends onto the line to the elbow within a few
    # centimetres: a quadratic Bezier, its section turning with the curve.
    bend = origin - rotation[:, 0] * min(0.03, 0.2 * length)
    start = origin + rotation[:, 0] * 0.004
    vertices = []
    angles = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    for s in np.linspace(0.0, 1.0, RINGS) ** 1.5:
        centre = (1 - s) ** 2 * start + 2 * s * (1 - s) * bend + s**2 * elbow
        tangent = 2 * (1 - s) * (bend - start) + 2 * s * (elbow - bend)
        x = -tangent / np.linalg.norm(tangent)
        z = rotation[:, 2] - x * (x @ rotation[:, 2])
        norm = np.linalg.norm(z)
        z = z / norm if norm > 1e-3 else np.cross(x, rotation[:, 1])
        y = np.cross(z, x)
        grow = 1 + (GROWTH - 1) * np.sin(min(s * 1.4, 1.0) * np.pi / 2)
        # Round out towards the muscles of the forearm.
        ay = half[0] * grow * (1 + 0.15 * s)
        ring = (
            centre
            + y * middle[0] + z * middle[1]
            + np.outer(np.cos(angles) * ay, y)
            + np.outer(np.sin(angles) * half[1] * grow, z)
        )  # fmt: skip
        vertices.append(ring)
    return np.concatenate(vertices)
