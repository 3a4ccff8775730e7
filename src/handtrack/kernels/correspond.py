"""Correspondences from observed points to facing model vertices, by a windowed search (II.5.2.1).

Vertices that face the camera, seen or hidden, are sorted into square bins of the crop; a point
looks only into the bins around its own.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


RAY_COSINE = wp.constant(0.8)
"""Least cosine between a ray and the optical axis for which the search may stop early: views up to
74 degrees."""


@wp.kernel
def _clear_bins(
    # out
    heads_out: wp.array2d[int],
):
    """One bin of one row: empty."""
    rowid, binid = wp.tid()
    heads_out[rowid, binid] = -1


@wp.kernel
def _bin_vertices(
    # in
    row_hand_in: wp.array[int],
    crops_in: wp.array2d[float],
    vertices_in: wp.array2d[wp.vec3],
    normals_in: wp.array2d[wp.vec3],
    bin_size: float,
    nbin: int,
    # out
    heads_io: wp.array2d[int],
    next_out: wp.array2d[int],
):
    """One vertex of one row: join its bin's list when it faces the camera."""
    rowid, vertid = wp.tid()
    hand = row_hand_in[rowid]
    v = vertices_in[rowid, vertid]
    next_out[rowid, vertid] = -1
    if v[2] < 0.02 or wp.dot(normals_in[rowid, vertid], v) >= 0.0:
        return
    x = (crops_in[hand, 0] * v[0] / v[2] + crops_in[hand, 2] + 0.5) / bin_size
    y = (crops_in[hand, 1] * v[1] / v[2] + crops_in[hand, 3] + 0.5) / bin_size
    if x >= 0.0 and y >= 0.0 and x < float(nbin) and y < float(nbin):
        binid = int(y) * nbin + int(x)
        next_out[rowid, vertid] = wp.atomic_exch(heads_io, rowid, binid, vertid)


@wp.kernel
def _match_points(
    # in
    row_hand_in: wp.array[int],
    crops_in: wp.array2d[float],
    cells_in: wp.array3d[float],
    points_in: wp.array3d[wp.vec3],
    point_normals_in: wp.array3d[wp.vec3],
    vertices_in: wp.array2d[wp.vec3],
    normals_in: wp.array2d[wp.vec3],
    heads_in: wp.array2d[int],
    next_in: wp.array2d[int],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    stride: int,
    bin_size: int,
    nbin: int,
    window: int,
    max_distance: float,
    min_cosine: float,
    wrist_x: float,
    # out
    matches_out: wp.array2d[int],
):
    """One sampled cell of one row: its nearest facing vertex (Eq. II.22), or why there is none."""
    rowid, slot = wp.tid()
    hand = row_hand_in[rowid]
    per_side = cells_in.shape[2] // stride
    row = (slot // per_side) * stride + stride // 2
    column = (slot % per_side) * stride + stride // 2
    z = cells_in[hand, row, column]
    if z <= 0.0 or not wp.isfinite(z):
        matches_out[rowid, slot] = -2
        return
    p = points_in[hand, row, column]
    palm = wp.transpose(rotations_in[rowid, 0]) @ (p - origins_in[rowid, 0])
    if palm[0] < wrist_x:
        matches_out[rowid, slot] = -2
        return
    observed = point_normals_in[hand, row, column]
    known = wp.length_sq(observed) > 0.0
    bx = column // bin_size
    by = row // bin_size
    # Cells from the point to the nearest edge of its own bin: a ring k bins out is that much
    # farther.
    edge = wp.min(
        wp.min(column - bx * bin_size, bx * bin_size + bin_size - 1 - column),
        wp.min(row - by * bin_size, by * bin_size + bin_size - 1 - row),
    )
    cell = RAY_COSINE * z / wp.max(crops_in[hand, 0], crops_in[hand, 1])
    best = max_distance * max_distance
    match = int(-1)
    for ring in range(window + 1):
        # Vertices of farther rings lie on rays that pass the point at a distance.
        apart = cell * (float((ring - 1) * bin_size + edge) + 0.5)
        if ring > 0 and apart * apart > best:
            break
        for j in range(wp.max(by - ring, 0), wp.min(by + ring, nbin - 1) + 1):
            # Inside the ring's rows only its two outer columns are new.
            step = wp.where(j == by - ring or j == by + ring, 1, wp.max(2 * ring, 1))
            i = bx - ring
            while i <= bx + ring:
                if i >= 0 and i < nbin:
                    vertid = heads_in[rowid, j * nbin + i]
                    while vertid >= 0:
                        d = wp.length_sq(vertices_in[rowid, vertid] - p)
                        # Ties go to the lower vertex, so that list order (a race on a GPU) cannot
                        # matter.
                        if d < best or (d == best and vertid < match):
                            if (
                                not known
                                or wp.dot(observed, normals_in[rowid, vertid]) > min_cosine
                            ):
                                best = d
                                match = vertid
                        vertid = next_in[rowid, vertid]
                i += step
    matches_out[rowid, slot] = match


def bin_vertices(
    row_hand: wp.array,
    crops: wp.array,
    vertices: wp.array,
    normals: wp.array,
    *,
    bin_size: int,
    nbin: int,
    heads: wp.array,
    following: wp.array,
) -> None:
    """Sort the facing vertices of every row into bins of the crop.

    Args:
        row_hand: Hand of each row, shape (nrow,).
        crops: Crop parameters, shape (nhand, CROP_SIZE).
        vertices: Vertices [m], camera frame, shape (nrow, nvert) vec3.
        normals: Unit normals, shape (nrow, nvert) vec3.
        bin_size: Side of a bin [cells].
        nbin: Bins per side.
        heads: Out: first vertex of each bin or -1, shape (nrow, nbin * nbin).
        following: Out: next vertex in the same bin or -1, shape (nrow, nvert).
    """
    wp.launch(_clear_bins, dim=heads.shape, inputs=[], outputs=[heads], device=heads.device)
    wp.launch(
        _bin_vertices,
        dim=vertices.shape,
        inputs=[row_hand, crops, vertices, normals, float(bin_size), nbin],
        outputs=[heads, following],
        device=vertices.device,
    )


def match_points(
    row_hand: wp.array,
    crops: wp.array,
    cells: wp.array,
    points: wp.array,
    point_normals: wp.array,
    vertices: wp.array,
    normals: wp.array,
    heads: wp.array,
    following: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    stride: int,
    bin_size: int,
    nbin: int,
    window: int,
    max_distance: float,
    min_cosine: float,
    wrist_x: float,
    matches: wp.array,
) -> None:
    """Nearest facing vertex of every sampled point.

    Args:
        row_hand: Hand of each row, shape (nrow,).
        crops: Crop parameters, shape (nhand, CROP_SIZE).
        cells: Depth cells, shape (nhand, n, n).
        points: Observed points [m], shape (nhand, n, n) vec3.
        point_normals: Observed normals or zero, shape (nhand, n, n) vec3.
        vertices: Vertices [m], shape (nrow, nvert) vec3.
        normals: Unit normals, shape (nrow, nvert) vec3.
        heads: First vertex of each bin, shape (nrow, nbin * nbin).
        following: Next vertex in the bin, shape (nrow, nvert).
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        stride: Every stride-th cell in both directions is a point.
        bin_size: Side of a bin [cells].
        nbin: Bins per side.
        window: Bins looked into on each side of the point's own.
        max_distance: Longest correspondence [m].
        min_cosine: Least cosine between observed and model normal; -1 accepts all.
        wrist_x: Points behind this palm-frame x belong to the forearm [m].
        matches: Out: vertex, -1 none near, -2 no point of the hand, shape (nrow, (n // stride)
            ** 2).
    """
    wp.launch(
        _match_points,
        dim=matches.shape,
        inputs=[
            row_hand, crops, cells, points, point_normals, vertices, normals, heads, following,
            rotations, origins, stride, bin_size, nbin, window, max_distance, min_cosine, wrist_x,
        ],
        outputs=[matches],
        device=matches.device,
    )  # fmt: skip
