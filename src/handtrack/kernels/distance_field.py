"""Signed distance of an object on a grid: made by mesh queries, read by other kernels."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class DistanceGrid:
    """Signed distances on a regular grid, negative inside. Metres."""

    values: wp.array3d[float]
    origin: wp.vec3
    spacing: float


@wp.kernel
def _measure_distances(
    # model
    mesh_id: wp.uint64,
    # in
    origin: wp.vec3,
    spacing: float,
    reach: float,
    # out
    values_io: wp.array3d[float],
):
    """One grid point: the smaller of what is there and its signed distance from a closed mesh."""
    i, j, k = wp.tid()
    point = origin + spacing * wp.vec3(float(i), float(j), float(k))
    found = wp.mesh_query_point_sign_winding_number(mesh_id, point, reach)
    if found.result:
        nearest = wp.mesh_eval_position(mesh_id, found.face, found.u, found.v)
        distance = found.sign * wp.length(point - nearest)
        values_io[i, j, k] = wp.min(values_io[i, j, k], distance)


@wp.func
def _cell_share(x: float, count: int):
    # Lower grid line and share of the way to the next, within the grid.
    inside = wp.clamp(x, 0.0, float(count - 1))
    low = wp.min(int(inside), count - 2)
    return low, inside - float(low)


@wp.func
def grid_distance(grid: DistanceGrid, point: wp.vec3) -> float:
    """Signed distance [m], trilinear; outside the grid the border's plus the way there."""
    local = (point - grid.origin) / grid.spacing
    i, u = _cell_share(local[0], grid.values.shape[0])
    j, v = _cell_share(local[1], grid.values.shape[1])
    k, w = _cell_share(local[2], grid.values.shape[2])
    low = wp.lerp(
        wp.lerp(grid.values[i, j, k], grid.values[i + 1, j, k], u),
        wp.lerp(grid.values[i, j + 1, k], grid.values[i + 1, j + 1, k], u),
        v,
    )
    high = wp.lerp(
        wp.lerp(grid.values[i, j, k + 1], grid.values[i + 1, j, k + 1], u),
        wp.lerp(grid.values[i, j + 1, k + 1], grid.values[i + 1, j + 1, k + 1], u),
        v,
    )
    nearest = wp.vec3(float(i) + u, float(j) + v, float(k) + w)
    return wp.lerp(low, high, w) + grid.spacing * wp.length(local - nearest)


@wp.func
def grid_normal(grid: DistanceGrid, point: wp.vec3) -> wp.vec3:
    """Unit direction in which the distance grows, by central differences over two cells."""
    h = grid.spacing
    x = wp.vec3(h, 0.0, 0.0)
    y = wp.vec3(0.0, h, 0.0)
    z = wp.vec3(0.0, 0.0, h)
    return wp.normalize(
        wp.vec3(
            grid_distance(grid, point + x) - grid_distance(grid, point - x),
            grid_distance(grid, point + y) - grid_distance(grid, point - y),
            grid_distance(grid, point + z) - grid_distance(grid, point - z),
        )
    )


@wp.kernel
def _look_up_distances(
    # model
    grid: DistanceGrid,
    # in
    points_in: wp.array[wp.vec3],
    # out
    distances_out: wp.array[float],
    normals_out: wp.array[wp.vec3],
):
    """One point: its signed distance and the normal there."""
    pointid = wp.tid()
    distances_out[pointid] = grid_distance(grid, points_in[pointid])
    normals_out[pointid] = grid_normal(grid, points_in[pointid])


def measure_distances(
    mesh: wp.Mesh,
    origin: tuple[float, float, float],
    spacing: float,
    reach: float,
    *,
    values: wp.array,
) -> None:
    """Signed distances of grid points from a closed mesh, joined with what the grid holds.

    Args:
        mesh: The mesh, made with support for winding numbers.
        origin: Place of the grid's first point [m].
        spacing: Distance between grid points [m].
        reach: Farthest surface that is looked for [m].
        values: In and out: distances [m], shape (nx, ny, nz); the smaller one stays.
    """
    wp.launch(
        _measure_distances,
        dim=values.shape,
        inputs=[mesh.id, wp.vec3(*origin), spacing, reach],
        outputs=[values],
        device=values.device,
    )


def look_up_distances(
    grid: DistanceGrid, points: wp.array, *, distances: wp.array, normals: wp.array
) -> None:
    """Distances and normals of a grid at points.

    Args:
        grid: Signed distances.
        points: Where [m], shape (npoint,) vec3.
        distances: Out: signed distances [m], shape (npoint,).
        normals: Out: unit normals, shape (npoint,) vec3.
    """
    wp.launch(
        _look_up_distances,
        dim=points.shape,
        inputs=[grid, points],
        outputs=[distances, normals],
        device=points.device,
    )
