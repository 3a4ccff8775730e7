"""Nearest facing model point of every observed point (thesis Eq. II.22), by brute force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """What one sampled cell may answer."""

    kind: str
    """"none": nothing there, or the forearm; "far": nothing near enough; "vertex"."""
    distance: float = np.inf
    """Distance to the nearest admissible vertex inside the window [m]."""
    vertex: int = -1
    """That vertex."""
    nearest_anywhere: int = -1
    """Nearest admissible vertex, inside the window or not, when nearer than `max_distance`."""
    in_window: bool = False
    """Whether that vertex lies inside the window."""


def pixels(vertices: Float, crop: Float) -> Float:
    """Continuous cell coordinates (column, row) of points, shape (n, 2)."""
    return crop[:2] * vertices[:, :2] / vertices[:, 2:3] + crop[2:4]


def facing(vertices: Float, normals: Float) -> NDArray[np.bool_]:
    """Which vertices face the camera: normal and line of sight are over 90 degrees apart."""
    return ((vertices * normals).sum(1) < 0) & (vertices[:, 2] >= 0.02)


def match_points(
    crop: Float,
    cells: Float,
    points: Float,
    point_normals: Float,
    vertices: Float,
    normals: Float,
    palm: tuple[Float, Float],
    *,
    stride: int,
    bin_size: int,
    window: int,
    max_distance: float,
    min_cosine: float,
    wrist_x: float,
) -> list[Match]:
    """Answers for all sampled cells of one row, in the order of slots."""
    size = len(cells)
    uv = pixels(vertices, crop)
    # A vertex belongs to the cell whose centre is nearest, a cell to one square bin.
    cell = np.floor(uv + 0.5)
    visible = facing(vertices, normals) & (cell >= 0).all(1) & (cell < size).all(1)
    bins = cell // bin_size
    answers = []
    for row in range(stride // 2, size, stride):
        for column in range(stride // 2, size, stride):
            z, p = cells[row, column], points[row, column]
            in_palm = palm[0].T @ (p - palm[1])
            if not (z > 0 and np.isfinite(z)) or in_palm[0] < wrist_x:
                answers.append(Match(kind="none"))
                continue
            distance = np.linalg.norm(vertices - p, axis=1)
            near = visible & (distance < max_distance)
            observed = point_normals[row, column]
            if observed.any():
                near &= normals @ observed > min_cosine
            own = np.array([column, row]) // bin_size
            inside = near & (np.abs(bins - own) <= window).all(1)
            anywhere = int(np.where(near, distance, np.inf).argmin()) if near.any() else -1
            in_window = anywhere >= 0 and bool(inside[anywhere])
            if not inside.any():
                answers.append(Match(kind="far", nearest_anywhere=anywhere, in_window=in_window))
                continue
            best = int(np.where(inside, distance, np.inf).argmin())
            answers.append(
                Match(
                    kind="vertex",
                    distance=float(distance[best]),
                    vertex=best,
                    nearest_anywhere=anywhere,
                    in_window=in_window,
                )
            )
    return answers
