"""From the depth image to what fitting reads: a metric crop, its points and its silhouette.

The crop is a virtual camera: a square grid of cells laid over the hand, each cell showing the
nearest pixel. Cells keep about the same size in metres at any distance and for any camera.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False})

CROP_SIZE = 8
"""Columns of a crop's parameters: fx fy cx cy of the grid [cells], x0 y0 [pixels], step [pixels],
unused."""

GATE_SIZE = 4
"""Columns of a crop's gate: centre x y z and radius [m] of the sphere that holds the hand."""


def crop_parameters(
    intrinsics: tuple[float, float, float, float], centres: NDArray, *, cells: int, span: float
) -> NDArray[np.float32]:
    """Crops laid around points, never finer than the camera's own pixels.

    Args:
        intrinsics: fx, fy, cx, cy of the camera [pixels].
        centres: Middle of each crop [m], camera frame, shape (n, 3).
        cells: Cells along one side.
        span: Width of a crop at its centre's distance [m].

    Returns:
        Crop parameters, shape (n, CROP_SIZE).
    """
    fx, fy, cx, cy = intrinsics
    z = np.maximum(centres[:, 2], 0.05)
    pixel = np.array([fx, fy]) * centres[:, :2] / z[:, None] + np.array([cx, cy])
    step = np.maximum(span * fx / z / cells, 1.0)
    start = pixel - step[:, None] * (cells - 1) / 2
    crops = np.zeros((len(centres), CROP_SIZE), np.float32)
    crops[:, 0], crops[:, 1] = fx / step, fy / step
    crops[:, 2] = (cx - start[:, 0]) / step
    crops[:, 3] = (cy - start[:, 1]) / step
    crops[:, 4:6], crops[:, 6] = start, step
    return crops


@wp.kernel
def _crop_depth(
    # in
    depth_in: wp.array3d[float],
    intrinsics_in: wp.array[float],
    crops_in: wp.array2d[float],
    gates_in: wp.array2d[float],
    same_surface: float,
    # out
    cells_out: wp.array3d[float],
    points_out: wp.array3d[wp.vec3],
):
    """One cell of one hand: z and point, smoothed over the pixels around the nearest one.

    0 is background (nothing measured, or something farther than the hand may be), infinity is
    unknown (outside the image, hidden by something nearer than the hand may be, or a stray pixel at
    an edge).
    """
    hand, row, column = wp.tid()
    x = int(wp.floor(crops_in[hand, 4] + crops_in[hand, 6] * float(column) + 0.5))
    y = int(wp.floor(crops_in[hand, 5] + crops_in[hand, 6] * float(row) + 0.5))
    cells_out[hand, row, column] = wp.inf
    points_out[hand, row, column] = wp.vec3(0.0)
    if x < 0 or x >= depth_in.shape[2] or y < 0 or y >= depth_in.shape[1]:
        return
    centre = wp.vec3(gates_in[hand, 0], gates_in[hand, 1], gates_in[hand, 2])
    radius = gates_in[hand, 3]
    z = depth_in[hand, y, x]
    nearest = float(wp.inf)
    total = float(0.0)
    number = int(0)
    around = int(0)
    for j in range(-1, 2):
        for i in range(-1, 2):
            if (
                x + i >= 0
                and x + i < depth_in.shape[2]
                and y + j >= 0
                and y + j < depth_in.shape[1]
            ):
                other = depth_in[hand, y + j, x + i]
                if other > 0.0:
                    around += 1
                    nearest = wp.min(nearest, other)
                    if wp.abs(other - z) < same_surface:
                        total += other
                        number += 1
    if z > 0.0:
        # A pixel with no neighbour on its own surface flies between two surfaces.
        if number < 4:
            return
        z = total / float(number)
    else:
        if around < 5:
            cells_out[hand, row, column] = 0.0
            return
        # A hole inside a surface: take the neighbours' depth where they agree.
        total = float(0.0)
        number = int(0)
        for j in range(-1, 2):
            for i in range(-1, 2):
                if (
                    x + i >= 0
                    and x + i < depth_in.shape[2]
                    and y + j >= 0
                    and y + j < depth_in.shape[1]
                ):
                    other = depth_in[hand, y + j, x + i]
                    if other > 0.0 and other - nearest < same_surface:
                        total += other
                        number += 1
        if number < 5:
            return
        z = total / float(number)
    point = wp.vec3(
        (float(x) - intrinsics_in[2]) / intrinsics_in[0] * z,
        (float(y) - intrinsics_in[3]) / intrinsics_in[1] * z,
        z,
    )
    if wp.length(point - centre) > radius:
        z = wp.where(z < centre[2], float(wp.inf), 0.0)
    cells_out[hand, row, column] = z
    points_out[hand, row, column] = point


@wp.kernel
def _scan_columns(
    # in
    cells_in: wp.array3d[float],
    # out
    nearest_out: wp.array3d[int],
):
    """One column of one hand: per cell the row of the column's nearest foreground cell or -1."""
    hand, column = wp.tid()
    rows = cells_in.shape[1]
    last = int(-1)
    for row in range(rows):
        z = cells_in[hand, row, column]
        if z > 0.0:
            last = row
        nearest_out[hand, row, column] = last
    last = int(-1)
    for back in range(rows):
        row = rows - 1 - back
        above = nearest_out[hand, row, column]
        if above == row:
            last = row
        elif last >= 0 and (above < 0 or last - row < row - above):
            nearest_out[hand, row, column] = last


@wp.kernel
def _estimate_normals(
    # in
    cells_in: wp.array3d[float],
    points_in: wp.array3d[wp.vec3],
    reach: int,
    max_step: float,
    # out
    normals_out: wp.array3d[wp.vec3],
):
    """One cell of one hand: normal from neighbours `reach` cells away, zero where unknown."""
    hand, row, column = wp.tid()
    rows = cells_in.shape[1]
    columns = cells_in.shape[2]
    normal = wp.vec3(0.0)
    z = cells_in[hand, row, column]
    inside = row >= reach and column >= reach and row < rows - reach and column < columns - reach
    if inside and z > 0.0 and wp.isfinite(z):
        zl = cells_in[hand, row, column - reach]
        zr = cells_in[hand, row, column + reach]
        zt = cells_in[hand, row - reach, column]
        zb = cells_in[hand, row + reach, column]
        # One-sided where the other side lies across a depth edge.
        here = points_in[hand, row, column]
        along_x = wp.vec3(0.0)
        along_y = wp.vec3(0.0)
        if wp.abs(zr - z) < max_step:
            along_x += points_in[hand, row, column + reach] - here
        if wp.abs(zl - z) < max_step:
            along_x += here - points_in[hand, row, column - reach]
        if wp.abs(zb - z) < max_step:
            along_y += points_in[hand, row + reach, column] - here
        if wp.abs(zt - z) < max_step:
            along_y += here - points_in[hand, row - reach, column]
        cross = wp.cross(along_y, along_x)
        if wp.length(cross) > 0.0:
            normal = wp.normalize(cross)
    normals_out[hand, row, column] = normal


def crop_depth(
    depth: wp.array,
    intrinsics: wp.array,
    crops: wp.array,
    gates: wp.array,
    *,
    same_surface: float,
    cells: wp.array,
    points: wp.array,
) -> None:
    """Sample each hand's crop from its depth image.

    Args:
        depth: Depth images [m], shape (nhand, height, width).
        intrinsics: fx, fy, cx, cy [pixels], shape (4,).
        crops: Crop parameters, shape (nhand, CROP_SIZE).
        gates: Sphere that holds the hand, shape (nhand, GATE_SIZE).
        same_surface: Neighbouring pixels closer in depth than this share a surface [m].
        cells: Out: z [m], 0 background, infinity unknown, shape (nhand, n, n).
        points: Out: observed points [m], camera frame, shape (nhand, n, n) vec3.
    """
    wp.launch(
        _crop_depth,
        dim=cells.shape,
        inputs=[depth, intrinsics, crops, gates, same_surface],
        outputs=[cells, points],
        device=cells.device,
    )


def scan_columns(cells: wp.array, *, nearest: wp.array) -> None:
    """Row of the nearest foreground cell in the same column, -1 for none, shape (nhand, n, n).

    First half of an exact distance transform; the second half is done only where it is asked for.
    """
    wp.launch(
        _scan_columns,
        dim=(cells.shape[0], cells.shape[2]),
        inputs=[cells],
        outputs=[nearest],
        device=cells.device,
    )


def estimate_normals(
    cells: wp.array, points: wp.array, *, reach: int, max_step: float, normals: wp.array
) -> None:
    """Unit normals of the observed surface towards the camera, zero where unknown.

    Args:
        cells: Depth cells, shape (nhand, n, n).
        points: Observed points [m], shape (nhand, n, n) vec3.
        reach: Distance of the neighbours used [cells].
        max_step: Depth steps above this are edges [m].
        normals: Out: normals, camera frame, shape (nhand, n, n) vec3.
    """
    wp.launch(
        _estimate_normals,
        dim=cells.shape,
        inputs=[cells, points, reach, max_step],
        outputs=[normals],
        device=cells.device,
    )
