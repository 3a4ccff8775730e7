"""Skinning weights of the 16 bones from the weights of MakeHuman's rig.

Forearm, wrist and metacarpals become the palm. A vertex keeps the palm and one finger chain, at
most three bones in all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.learning.weights import slot_weights
from handtrack.hand.skeleton import NBONE

Float = NDArray[np.float64]


def bone_weights(rig_weights: dict[str, Float], base_ids: NDArray[np.int64]) -> Float:
    """Weights of the 16 bones, rows sum to one, shape (n, 16), at the base vertices `base_ids`."""
    dense = np.zeros((base_ids.size, NBONE))
    for name, values in rig_weights.items():
        column = 0
        if name.startswith("finger") and name.endswith(".R"):
            finger, segment = (int(c) for c in name[len("finger") : -len(".R")].split("-"))
            column = 1 + 3 * (finger - 1) + (segment - 1)
        dense[:, column] += values[base_ids]
    return dense / dense.sum(axis=1, keepdims=True)


def sparse_weights(dense: Float) -> tuple[NDArray[np.int32], Float]:
    """The palm and one chain per vertex, three slots.

    What other chains weigh goes to the palm, which keeps the webs between fingers smooth.

    Args:
        dense: Weights, shape (n, 16).

    Returns:
        Bones, shape (n, 3), largest weight first, and weights, shape (n, 3); unused slots are palm
        with weight 0.
    """
    dense = dense.copy()
    chains = dense[:, 1:].reshape(-1, 5, 3)
    winner = chains.sum(axis=2).argmax(axis=1)
    for chain in range(5):
        lost = winner != chain
        columns = slice(1 + 3 * chain, 4 + 3 * chain)
        dense[lost, 0] += dense[lost, columns].sum(axis=1)
        dense[lost, columns] = 0.0
    dense[dense < 1e-3] = 0.0
    return slot_weights(dense)


def smoothed(dense: Float, faces: NDArray, rounds: int) -> Float:
    """Weights averaged with those of neighbouring vertices, `rounds` times."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    for _ in range(rounds):
        total = np.zeros_like(dense)
        count = np.zeros(len(dense))
        for a, b in ((0, 1), (1, 0)):
            np.add.at(total, edges[:, a], dense[edges[:, b]])
            np.add.at(count, edges[:, a], 1.0)
        dense = 0.5 * dense + 0.5 * total / count[:, None]
    return dense
