"""What normal forces leave unbalanced, by non-negative least squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

SUM_WEIGHT = 100.0
"""Weight of the row that keeps the shares' sum at one, against wrenches of about one."""


def imbalance(points: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """Distance of the origin from the hull of the contacts' unit wrenches (`_imbalance`).

    Args:
        points: Contacts [m], shape (ncontact, 3).
        normals: Unit normals there, shape (ncontact, 3).
    """
    arms = points - points.mean(0)
    arms = arms / max(float(np.linalg.norm(arms, axis=1).mean()), 0.01)
    wrenches = np.concatenate([normals, np.cross(arms, normals)], axis=1)
    rows = np.concatenate([wrenches.T, np.full((1, len(points)), SUM_WEIGHT)])
    shares, _ = nnls(rows, np.append(np.zeros(6), SUM_WEIGHT))
    return float(np.linalg.norm(shares @ wrenches) / shares.sum())
