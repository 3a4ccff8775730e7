"""Where the 21 keypoints of a MakeHuman hand are: linear functions of its vertices.

The rig's joint cubes follow every target, so keypoints made from them do too. Two things are
corrected, because the rig serves animation: its finger bones start at the webs, and the thumb's
metacarpal starts half-way along it. The joints are moved along the rig's own bones until the mean
adult has the bone lengths measured by Buryanov & Kotiuk (2010), "Proportions of hand segments",
Int. J. Morphol. 28(3):755-758. The little finger, drawn too short, is lengthened besides.
Fingertips are the ends of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hand_builder.makehuman import Joint

Float = NDArray[np.float64]

RIG_BONES: tuple[str, ...] = (
    "lowerarm01.R",
    "wrist.R",
    *(f"metacarpal{k}.R" for k in range(1, 5)),
    *(f"finger{f}-{k}.R" for f in range(1, 6) for k in range(1, 4)),
)
"""Bones of the rig whose joints are used."""

KNUCKLES: dict[int, dict[str, float]] = {
    2: {"finger2-1.R.head": 1.48, "finger2-2.R.head": -0.48},
    3: {"finger3-1.R.head": 0.88, "metacarpal2.R.head": 0.12},
    4: {"finger4-1.R.head": 0.84, "metacarpal3.R.head": 0.16},
    5: {"finger5-1.R.head": 0.86, "metacarpal4.R.head": 0.14},
}
"""Metacarpophalangeal joints as mixtures of rig joints: back along the metacarpal, for the index
back along the finger, since the rig lets the index and middle metacarpals start in one point."""

INNER_SHIFT = {2: 0.07, 3: 0.10}
"""Share of the way to the next joint by which the rig's second and third finger joint move out."""

THUMB_BASE = {"finger1-1.R.head": 0.276, "finger1-2.R.head": 0.288, "wrist.R.head": 0.436}
"""Trapeziometacarpal joint as a mixture of rig joints."""

THUMB_KNUCKLE = {"finger1-2.R.head": 0.88, "finger1-3.R.head": 0.12}
"""Thumb metacarpophalangeal joint as a mixture of rig joints."""

BONE_FACTORS = np.ones(16)
"""Mean factor of each bone's length on top of MakeHuman's: its little finger is 8 mm too short."""
BONE_FACTORS[13:16] = 1.12

TIP_DEPTH = 0.0025
"""A fingertip is the mean of the vertices within so much [m] of the finger's end."""


def keypoint_mixtures() -> list[dict[str, float]]:
    """Each keypoint (order of `handtrack.hand.skeleton.KEYPOINTS`) as a mixture of rig joints."""
    points: list[dict[str, float]] = [{"wrist.R.head": 1.0}]
    points += [THUMB_BASE, THUMB_KNUCKLE, {"finger1-3.R.head": 1.0}, {"finger1-3.R.tail": 1.0}]
    for finger in range(2, 6):
        points += [
            KNUCKLES[finger],
            {
                f"finger{finger}-2.R.head": 1.0 - INNER_SHIFT[2],
                f"finger{finger}-3.R.head": INNER_SHIFT[2],
            },
            {
                f"finger{finger}-3.R.head": 1.0 - INNER_SHIFT[3],
                f"finger{finger}-3.R.tail": INNER_SHIFT[3],
            },
            {f"finger{finger}-3.R.tail": 1.0},
        ]
    return points


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointMap:
    """Keypoints as weighted sums of base mesh vertices."""

    base_ids: NDArray[np.int64]
    """Base vertices that take part, shape (n,)."""
    weights: Float
    """Weight of each of them, rows sum to one, shape (21, n)."""

    def keypoints(self, vertices: Float) -> Float:
        """Keypoints [m], shape (21, 3), of the vertices at `base_ids`, shape (n, 3)."""
        return self.weights @ vertices


def keypoint_map(
    joints: dict[str, Joint], reference: Float, skin_ids: NDArray[np.int64]
) -> KeypointMap:
    """Builds the map; fingertips are found on a reference subject.

    Args:
        joints: Joints of the rig.
        reference: All base vertices of the reference subject [m], shape (19158, 3).
        skin_ids: Base vertices of the hand's skin.

    Returns:
        Map for all subjects.
    """
    rows: list[dict[int, float]] = []
    for mixture in keypoint_mixtures():
        row: dict[int, float] = {}
        for name, share in mixture.items():
            ids = joints[name].vertex_ids
            for vertex in ids:
                row[int(vertex)] = row.get(int(vertex), 0.0) + share / ids.size
        rows.append(row)
    for finger in range(5):
        tip, joint = 4 + 4 * finger, 3 + 4 * finger
        start, end = (
            sum(share * reference[vertex] for vertex, share in rows[k].items())
            for k in (joint, tip)
        )
        ids = _end_of_finger(reference, skin_ids, start, end)
        rows[tip] = {int(vertex): 1.0 / ids.size for vertex in ids}

    base_ids = np.unique([vertex for row in rows for vertex in row])
    weights = np.zeros((len(rows), base_ids.size))
    column = {int(vertex): k for k, vertex in enumerate(base_ids)}
    for k, row in enumerate(rows):
        for vertex, share in row.items():
            weights[k, column[vertex]] = share
    return KeypointMap(base_ids=base_ids, weights=weights)


def _end_of_finger(
    vertices: Float, skin_ids: NDArray[np.int64], start: Float, end: Float
) -> NDArray[np.int64]:
    """Skin vertices at the end of the distal phalanx from `start` to `end`."""
    direction = (end - start) / np.linalg.norm(end - start)
    offset = vertices[skin_ids] - start
    along = offset @ direction
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    near = (across < 0.012) & (along > 0)
    return skin_ids[near & (along > along[near].max() - TIP_DEPTH)]


def to_palm_frame(points: Float, keypoints: Float) -> Float:
    """Points in the palm frame: origin wrist, x to the middle knuckle, z towards the thumb side.

    Args:
        points: Points in the file's frame [m], shape (n, 3).
        keypoints: Keypoints in the same frame, shape (21, 3).

    Returns:
        Points in the palm frame [m], shape (n, 3).
    """
    wrist, index, middle, little = (keypoints[k] for k in (0, 5, 9, 17))
    x = (middle - wrist) / np.linalg.norm(middle - wrist)
    z = index - little
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    return (points - wrist) @ np.stack([x, np.cross(z, x), z]).T
