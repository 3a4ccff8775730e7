"""Cuts the right hand out of the body mesh, closes it and triangulates it.

The cut follows one edge ring of the forearm, so every subject has the same vertices and faces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class HandTopology:
    """Which base vertices make the hand mesh, and its triangles."""

    base_ids: Int
    """Base vertices of the skin, shape (nvert - 1,); the last hand vertex is the cap's centre."""
    ring: Int
    """Hand vertices along the cut, in order, shape (nring,)."""
    faces: NDArray[np.int32]
    """Triangles, outward counter-clockwise, shape (nface, 3)."""

    @property
    def nvert(self) -> int:
        """Number of hand vertices."""
        return self.base_ids.size + 1

    def hand_vertices(self, base_vertices: Float) -> Float:
        """Hand vertices, shape (nvert, 3), of base vertices at `base_ids`, shape (nvert - 1, 3)."""
        centre = base_vertices[self.ring].mean(axis=0)
        return np.vstack([base_vertices, centre])


def cut_hand(
    vertices: Float, quads: Int, *, wrist: Float, elbow: Float, above: float
) -> HandTopology:
    """Takes the part of the body beyond a plane across the forearm.

    Args:
        vertices: Base vertices [m], shape (n, 3).
        quads: Quads of the body skin, shape (m, 4).
        wrist: Wrist joint, shape (3,).
        elbow: Elbow joint, shape (3,).
        above: Distance of the plane from the wrist towards the elbow [m].

    Returns:
        Topology of the closed hand.
    """
    axis = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    along = (vertices - wrist) @ axis
    across = np.linalg.norm(vertices - wrist - along[:, None] * axis, axis=1)
    # 0.2 m around the forearm's axis keeps every finger and nothing of the trunk or leg.
    inside = (along > -above) & (across < 0.2)
    kept = quads[inside[quads].all(axis=1)]
    used = np.unique(kept)
    kept = _component_of(kept, int(used[np.argmin(np.abs(along[used]) + across[used])]))
    base_ids = np.unique(kept)
    renumber = np.full(len(vertices), -1)
    renumber[base_ids] = np.arange(base_ids.size)
    kept = renumber[kept]

    ring = _boundary_loop(kept)
    cap = [(ring[k], ring[k - 1], base_ids.size) for k in range(len(ring))]
    faces = np.vstack([_triangulate(kept, vertices[base_ids]), cap])
    hand = HandTopology(base_ids=base_ids, ring=np.array(ring), faces=faces.astype(np.int32))
    if _volume(hand.hand_vertices(vertices[base_ids]), hand.faces) < 0:
        hand = HandTopology(base_ids=base_ids, ring=hand.ring, faces=hand.faces[:, ::-1].copy())
    return hand


def _component_of(quads: Int, seed: int) -> Int:
    """Quads connected to the seed vertex through shared vertices."""
    reached = np.zeros(int(quads.max()) + 1, dtype=bool)
    reached[seed] = True
    while True:
        touched = reached[quads].any(axis=1)
        before = reached.sum()
        reached[quads[touched]] = True
        if reached.sum() == before:
            return quads[touched]


def _boundary_loop(quads: Int) -> list[int]:
    """The single loop of edges that belong to one quad only, directed as in their quads."""
    edges = {(int(q[k]), int(q[(k + 1) % 4])) for q in quads for k in range(4)}
    follow = {a: b for a, b in edges if (b, a) not in edges}
    start = next(iter(follow))
    loop = [start]
    while follow[loop[-1]] != start:
        loop.append(follow[loop[-1]])
    if len(loop) != len(follow):
        raise ValueError(f"the cut has {len(follow)} open edges, but its first loop {len(loop)}")
    return loop


def _triangulate(quads: Int, vertices: Float) -> Int:
    """Splits each quad along its shorter diagonal."""
    a, b, c, d = (quads[:, k] for k in range(4))
    ac = np.linalg.norm(vertices[a] - vertices[c], axis=1)
    bd = np.linalg.norm(vertices[b] - vertices[d], axis=1)
    short_ac = (ac <= bd)[:, None]
    first = np.where(short_ac, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(short_ac, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return np.vstack([first, second])


def _volume(vertices: Float, faces: NDArray) -> float:
    """Signed volume of a closed mesh [m^3], positive when faces point outward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
