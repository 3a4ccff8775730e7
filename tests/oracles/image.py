"""What the crop kernels say they do, cell by cell: crop, distance transform, normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def crop_cells(
    depth: Float, camera: Float, crop: Float, gate: Float, size: int, *, same_surface: float
) -> tuple[Float, Float]:
    """Cells [m] and points [m] of one hand's crop.

    Args:
        depth: Depth image [m], shape (height, width); what is not positive is no measurement.
        camera: fx, fy, cx, cy [pixels].
        crop: Crop parameters; 4 to 6 are x0, y0 and step [pixels].
        gate: Centre and radius of the sphere that holds the hand [m].
        size: Cells along one side.
        same_surface: Neighbouring pixels closer in depth than this share a surface [m].

    Returns:
        z per cell: 0 background, infinity unknown; and the points, zero where unknown.
    """
    height, width = depth.shape
    cells, points = np.full((size, size), np.inf), np.zeros((size, size, 3))
    measured = np.where(depth > 0, depth, 0.0)
    for row, column in np.ndindex(size, size):
        x, y = (int(np.floor(crop[4 + k] + crop[6] * (column, row)[k] + 0.5)) for k in (0, 1))
        if not (0 <= x < width and 0 <= y < height):
            continue
        around = measured[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].ravel()
        around = around[around > 0]
        z = measured[y, x]
        if z > 0:
            with np.errstate(invalid="ignore"):
                surface = around[np.abs(around - z) < same_surface]
            if len(surface) < 4:
                continue  # a stray pixel
        else:
            if len(around) < 5:
                cells[row, column] = 0.0
                continue
            # A hole: filled from the nearest surface around it, when that is most of the ring.
            with np.errstate(invalid="ignore"):
                surface = around[around - around.min() < same_surface]
            if len(surface) < 5:
                continue
        z = surface.mean()
        point = np.array([(x - camera[2]) / camera[0] * z, (y - camera[3]) / camera[1] * z, z])
        points[row, column] = point
        cells[row, column] = z
        if np.linalg.norm(point - gate[:3]) > gate[3]:
            cells[row, column] = np.inf if z < gate[2] else 0.0
    return cells, points


def nearest_in_column(cells: Float) -> NDArray[np.int64]:
    """Distance along the column to the nearest cell that is not background, -1 for none."""
    rows, columns = cells.shape
    distance = np.full((rows, columns), -1)
    for column in range(columns):
        filled = np.flatnonzero(cells[:, column] > 0)
        if len(filled):
            distance[:, column] = np.abs(np.arange(rows)[:, None] - filled).min(1)
    return distance


def squared_distances(cells: Float) -> Float:
    """Squared distance of every cell to the nearest that is not background, by brute force."""
    filled = np.argwhere(cells > 0)
    if not len(filled):
        return np.full(cells.shape, np.inf)
    grid = np.stack(np.mgrid[: cells.shape[0], : cells.shape[1]], -1).reshape(-1, 2)
    gaps = ((grid[:, None] - filled[None]) ** 2).sum(-1).min(1)
    return gaps.reshape(cells.shape).astype(float)


def surface_normals(cells: Float, points: Float, *, reach: int, max_step: float) -> Float:
    """Normals towards the camera from neighbours `reach` away, one-sided at depth edges."""
    normals = np.zeros((*cells.shape, 3))
    rows, columns = cells.shape
    for row in range(reach, rows - reach):
        for column in range(reach, columns - reach):
            z = cells[row, column]
            if not (z > 0 and np.isfinite(z)):
                continue
            tangents = []
            for dr, dc in ((0, reach), (reach, 0)):
                ends = []
                for sign in (1, -1):
                    other = row + sign * dr, column + sign * dc
                    same = abs(cells[other] - z) < max_step
                    ends.append(points[other] if same else points[row, column])
                tangents.append(ends[0] - ends[1])
            normal = np.cross(tangents[1], tangents[0])
            if np.linalg.norm(normal) > 0:
                normals[row, column] = normal / np.linalg.norm(normal)
    return normals
