"""Residuals and their compact Jacobian rows (Eq. II.23, II.27).

A vertex depends on the six unknowns of the palm and at most five angles of its finger, so one row
is eleven numbers and the finger's index; the 27-column Jacobian is never stored. The derivative is
that of linear blend skinning itself, not of a vertex glued to one bone.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

NLOCAL = 11
"""Unknowns of one row: translation 3, palm rotation 3, angles of one finger 5."""

vec11 = wp.types.vector(length=NLOCAL, dtype=float)


@wp.func
def _chain_angle(chain: int) -> int:
    # First joint angle of a finger: the thumb has five, the others four.
    return wp.where(chain == 0, 0, 1 + 4 * chain)


@wp.func
def vertex_row(
    # model
    weight_bones_in: wp.array2d[int],
    weights_in: wp.array2d[float],
    local_vertices_in: wp.array3d[wp.vec3],
    angle_bones_in: wp.array[int],
    hand: int,
    # in
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    axes_in: wp.array2d[wp.vec3],
    rowid: int,
    vertid: int,
    chain: int,
    vertex: wp.vec3,
    direction: wp.vec3,
) -> vec11:
    """Derivative of direction . vertex by the eleven unknowns that move the vertex."""
    row = vec11()
    arm = wp.cross(vertex - origins_in[rowid, 0], direction)
    turn = wp.transpose(rotations_in[rowid, 0]) @ arm
    for k in range(3):
        row[k] = direction[k]
        row[3 + k] = turn[k]
    if chain >= 0:
        first = _chain_angle(chain)
        # d v / d angle = axis x sum over the bones beyond the joint of w (T v - origin).
        for k in range(5):
            if k < 4 or chain == 0:
                angle = first + k
                bone = angle_bones_in[angle]
                origin = origins_in[rowid, bone]
                lever = wp.vec3(0.0)
                for slot in range(3):
                    moved = weight_bones_in[vertid, slot]
                    weight = weights_in[vertid, slot]
                    if moved >= bone and weight > 0.0:
                        point = (
                            rotations_in[rowid, moved] @ local_vertices_in[hand, vertid, slot]
                            + origins_in[rowid, moved]
                        )
                        lever += weight * (point - origin)
                row[6 + k] = wp.dot(axes_in[rowid, angle], wp.cross(lever, direction))
    return row


@wp.func
def _robust_weight(squared: float, scale: float) -> float:
    # Geman-McClure as an iteratively reweighted square: (s^2 / (s^2 + r^2))^2.
    ratio = scale * scale / (scale * scale + squared)
    return ratio * ratio


@wp.kernel
def _point_rows(
    # model
    weight_bones_in: wp.array2d[int],
    weights_in: wp.array2d[float],
    local_vertices_in: wp.array3d[wp.vec3],
    vertex_chains_in: wp.array[int],
    angle_bones_in: wp.array[int],
    row_hand_in: wp.array[int],
    # in
    points_in: wp.array3d[wp.vec3],
    matches_in: wp.array2d[int],
    vertices_in: wp.array2d[wp.vec3],
    normals_in: wp.array2d[wp.vec3],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    axes_in: wp.array2d[wp.vec3],
    stride: int,
    directions: int,
    tangent_weight: float,
    weight: float,
    robust_scale: float,
    max_distance: float,
    palm_only: int,
    # out
    rows_out: wp.array2d[vec11],
    residuals_out: wp.array2d[float],
    chains_out: wp.array2d[int],
    costs_out: wp.array2d[float],
):
    """One sampled point of one row: plane residual, and the two tangential ones when asked for."""
    rowid, slot = wp.tid()
    match = matches_in[rowid, slot]
    for k in range(directions):
        chains_out[rowid, slot * directions + k] = -2
    cost = float(0.0)
    scale2 = robust_scale * robust_scale
    if match == -1:
        far = max_distance * max_distance
        cost = weight * far * scale2 / (scale2 + far)
    if match >= 0 and (palm_only == 0 or vertex_chains_in[wp.max(match, 0)] < 0):
        hand = row_hand_in[rowid]
        per_side = points_in.shape[2] // stride
        p = points_in[
            hand,
            (slot // per_side) * stride + stride // 2,
            (slot % per_side) * stride + stride // 2,
        ]
        vertex = vertices_in[rowid, match]
        normal = normals_in[rowid, match]
        gap = vertex - p
        squared = wp.length_sq(gap)
        root = wp.sqrt(weight * _robust_weight(squared, robust_scale))
        along = wp.dot(gap, normal)
        plain = along * along + tangent_weight * (squared - along * along)
        cost = weight * plain * scale2 / (scale2 + squared)
        chain = vertex_chains_in[match]
        helper = wp.where(wp.abs(normal[0]) < 0.6, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0))
        direction = normal
        factor = root
        for k in range(directions):
            if k == 1:
                direction = wp.normalize(wp.cross(normal, helper))
                factor = root * wp.sqrt(tangent_weight)
            if k == 2:
                direction = wp.cross(normal, direction)
            row = vertex_row(
                weight_bones_in, weights_in, local_vertices_in, angle_bones_in, hand,
                rotations_in, origins_in, axes_in, rowid, match, chain, vertex, direction,
            )  # fmt: skip
            rows_out[rowid, slot * directions + k] = factor * row
            residuals_out[rowid, slot * directions + k] = factor * wp.dot(gap, direction)
            chains_out[rowid, slot * directions + k] = wp.max(chain, 0)
    costs_out[rowid, slot] = cost


@wp.kernel
def _silhouette_rows(
    # model
    weight_bones_in: wp.array2d[int],
    weights_in: wp.array2d[float],
    local_vertices_in: wp.array3d[wp.vec3],
    vertex_chains_in: wp.array[int],
    vertex_is_hand_in: wp.array[int],
    angle_bones_in: wp.array[int],
    row_hand_in: wp.array[int],
    # in
    crops_in: wp.array2d[float],
    cells_in: wp.array3d[float],
    nearest_in: wp.array3d[int],
    vertices_in: wp.array2d[wp.vec3],
    normals_in: wp.array2d[wp.vec3],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    axes_in: wp.array2d[wp.vec3],
    first_slot: int,
    first_cost: int,
    reach: int,
    silhouette_weight: float,
    silhouette_scale: float,
    silhouette_margin: float,
    front_weight: float,
    front_scale: float,
    front_margin: float,
    # out
    rows_out: wp.array2d[vec11],
    residuals_out: wp.array2d[float],
    chains_out: wp.array2d[int],
    costs_out: wp.array2d[float],
):
    """One vertex of one row: pull it off the background, or push it behind what the camera saw."""
    rowid, vertid = wp.tid()
    slot = first_slot + vertid
    chains_out[rowid, slot] = -2
    costs_out[rowid, first_cost + vertid] = 0.0
    vertex = vertices_in[rowid, vertid]
    z = vertex[2]
    if vertex_is_hand_in[vertid] == 0 or z < 0.02:
        return
    if wp.dot(normals_in[rowid, vertid], vertex) >= 0.0:
        return
    hand = row_hand_in[rowid]
    n = cells_in.shape[2]
    u = crops_in[hand, 0] * vertex[0] / z + crops_in[hand, 2]
    v = crops_in[hand, 1] * vertex[1] / z + crops_in[hand, 3]
    if not (u > -0.5 and v > -0.5 and u < float(n) - 0.5 and v < float(n) - 0.5):
        return
    column = int(u + 0.5)
    row = int(v + 0.5)
    seen = cells_in[hand, row, column]
    if not wp.isfinite(seen):
        return
    direction = wp.vec3(0.0)
    residual = float(0.0)
    scale = float(1.0)
    weight = float(0.0)
    if seen > 0.0:
        gap = seen - z - front_margin
        if gap > 0.0:
            direction = wp.vec3(0.0, 0.0, 1.0)
            residual = -gap
            scale = front_scale
            weight = front_weight
    else:
        # Second half of the distance transform, outwards until no column can be nearer.
        best = reach * reach + 1
        best_row = int(0)
        best_column = int(-1)
        for k in range(reach + 1):
            if k * k < best:
                for side in range(2):
                    other = column + wp.where(side == 0, k, -k)
                    if other >= 0 and other < n:
                        candidate = nearest_in[hand, row, other]
                        if candidate >= 0:
                            d = k * k + (candidate - row) * (candidate - row)
                            if d < best:
                                best = d
                                best_row = candidate
                                best_column = other
        ex = float(reach)
        ey = float(0.0)
        distance = float(reach)
        if best_column >= 0:
            ex = u - float(best_column)
            ey = v - float(best_row)
            distance = wp.sqrt(ex * ex + ey * ey)
        # Metres per cell at the vertex.
        over = distance * z / crops_in[hand, 0] - silhouette_margin
        if over > 0.0:
            # The image direction lifted to 3D.
            residual = over
            scale = silhouette_scale
            weight = silhouette_weight
            if best_column >= 0:
                ex = ex / distance
                ey = ey / distance
                ey = ey * crops_in[hand, 1] / crops_in[hand, 0]
                direction = wp.vec3(ex, ey, -(ex * vertex[0] + ey * vertex[1]) / z)
    if weight > 0.0:
        squared = residual * residual
        costs_out[rowid, first_cost + vertid] = (
            weight * squared * scale * scale / (scale * scale + squared)
        )
        if wp.length_sq(direction) > 0.0:
            root = wp.sqrt(weight * _robust_weight(squared, scale))
            chain = vertex_chains_in[vertid]
            row_ = vertex_row(
                weight_bones_in, weights_in, local_vertices_in, angle_bones_in, hand,
                rotations_in, origins_in, axes_in, rowid, vertid, chain, vertex, direction,
            )  # fmt: skip
            rows_out[rowid, slot] = root * row_
            residuals_out[rowid, slot] = root * residual
            chains_out[rowid, slot] = wp.max(chain, 0)


def point_rows(
    weight_bones: wp.array,
    weights: wp.array,
    local_vertices: wp.array,
    vertex_chains: wp.array,
    angle_bones: wp.array,
    row_hand: wp.array,
    points: wp.array,
    matches: wp.array,
    vertices: wp.array,
    normals: wp.array,
    rotations: wp.array,
    origins: wp.array,
    axes: wp.array,
    *,
    stride: int,
    directions: int,
    tangent_weight: float,
    weight: float,
    robust_scale: float,
    max_distance: float,
    palm_only: bool = False,
    rows: wp.array,
    residuals: wp.array,
    chains: wp.array,
    costs: wp.array,
) -> None:
    """Residuals of the matched points: distance to the tangent plane, or to the vertex itself.

    Args:
        weight_bones: Bones that move each vertex, shape (nvert, 3).
        weights: Skinning weights, shape (nvert, 3).
        local_vertices: Vertices in the frames of those bones [m], shape (nhand, nvert, 3) vec3.
        vertex_chains: Finger of each vertex, -1 for the palm, shape (nvert,).
        angle_bones: Bone that each joint angle moves, shape (21,).
        row_hand: Hand of each row, shape (nrow,).
        points: Observed points [m], shape (nhand, n, n) vec3.
        matches: Vertex of each sampled point, -1 none near, -2 not the hand's, shape (nrow,
            npoint).
        vertices: Vertices [m], shape (nrow, nvert) vec3.
        normals: Unit normals, shape (nrow, nvert) vec3.
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        axes: Axes of the angles, shape (nrow, 21) vec3.
        stride: Every stride-th cell in both directions is a point.
        directions: 1 for the plane distance alone, 3 with the two tangential directions.
        tangent_weight: Weight of the tangential directions; 1 gives point-to-point (Eq. II.23).
        weight: Weight of a squared metre.
        robust_scale: Scale of the Geman-McClure weight [m].
        max_distance: Distance at which unmatched points are counted in the energy [m].
        palm_only: Leave out points matched to fingers.
        rows: Out: weighted Jacobian rows, shape (nrow, >= npoint * directions) vec11.
        residuals: Out: weighted residuals, same shape.
        chains: Out: finger of each residual, -2 for none, same shape.
        costs: Out: energy of each point, shape (nrow, >= npoint).
    """
    wp.launch(
        _point_rows,
        dim=matches.shape,
        inputs=[
            weight_bones, weights, local_vertices, vertex_chains, angle_bones, row_hand,
            points, matches, vertices, normals, rotations, origins, axes,
            stride, directions, tangent_weight, weight, robust_scale, max_distance,
            int(palm_only),
        ],
        outputs=[rows, residuals, chains, costs],
        device=rows.device,
    )  # fmt: skip


def silhouette_rows(
    weight_bones: wp.array,
    weights: wp.array,
    local_vertices: wp.array,
    vertex_chains: wp.array,
    vertex_is_hand: wp.array,
    angle_bones: wp.array,
    row_hand: wp.array,
    crops: wp.array,
    cells: wp.array,
    nearest: wp.array,
    vertices: wp.array,
    normals: wp.array,
    rotations: wp.array,
    origins: wp.array,
    axes: wp.array,
    *,
    first_slot: int,
    first_cost: int,
    reach: int,
    silhouette_weight: float,
    silhouette_scale: float,
    silhouette_margin: float,
    front_weight: float,
    front_scale: float,
    front_margin: float,
    rows: wp.array,
    residuals: wp.array,
    chains: wp.array,
    costs: wp.array,
) -> None:
    """Residuals of vertices that the image contradicts: off the silhouette, or before the surface.

    Args:
        weight_bones: Bones that move each vertex, shape (nvert, 3).
        weights: Skinning weights, shape (nvert, 3).
        local_vertices: Vertices in the frames of those bones [m], shape (nhand, nvert, 3) vec3.
        vertex_chains: Finger of each vertex, -1 for the palm, shape (nvert,).
        vertex_is_hand: 0 for vertices of the forearm stub, which the terms leave out, shape
            (nvert,).
        angle_bones: Bone that each joint angle moves, shape (21,).
        row_hand: Hand of each row, shape (nrow,).
        crops: Crop parameters, shape (nhand, CROP_SIZE).
        cells: Depth cells, shape (nhand, n, n).
        nearest: Column distance transform, shape (nhand, n, n).
        vertices: Vertices [m], shape (nrow, nvert) vec3.
        normals: Unit normals, shape (nrow, nvert) vec3.
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        axes: Axes of the angles, shape (nrow, 21) vec3.
        first_slot: First residual slot written; one per vertex.
        first_cost: First cost slot written; one per vertex.
        reach: Farthest foreground cell looked for [cells].
        silhouette_weight: Weight of a squared metre outside the silhouette.
        silhouette_scale: Geman-McClure scale of that distance [m].
        silhouette_margin: Distance outside the silhouette that is free [m].
        front_weight: Weight of a squared metre in front of the observed surface.
        front_scale: Geman-McClure scale of that distance [m].
        front_margin: Distance in front that is free [m].
        rows: Out: weighted Jacobian rows, shape (nrow, nslot) vec11.
        residuals: Out: weighted residuals, shape (nrow, nslot).
        chains: Out: finger of each residual, -2 for none, shape (nrow, nslot).
        costs: Out: energy of each vertex, shape (nrow, ncost).
    """
    wp.launch(
        _silhouette_rows,
        dim=vertices.shape,
        inputs=[
            weight_bones, weights, local_vertices, vertex_chains, vertex_is_hand, angle_bones,
            row_hand, crops, cells, nearest, vertices, normals, rotations, origins, axes,
            first_slot, first_cost, reach, silhouette_weight, silhouette_scale, silhouette_margin,
            front_weight, front_scale, front_margin,
        ],
        outputs=[rows, residuals, chains, costs],
        device=rows.device,
    )  # fmt: skip
