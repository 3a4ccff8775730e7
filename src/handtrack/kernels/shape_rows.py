"""Derivatives of residuals by the hand's shape, and their normal equations (Eq. II.11).

A residual's row by the pose begins with its direction times the root of its weight: its derivative
by translation. Turned into the frames of the bones that move the vertex, that direction meets the
derivatives of local vertices and joints by the shape, which are the same for all images. So one
kernel serves every residual over model vertices, whatever it measures.
"""

from __future__ import annotations

import warp as wp

from handtrack.kernels.residuals import NLOCAL, vec11

wp.set_module_options({"enable_backward": False})

PARTS = 16
"""Parts into which a row's residuals are split: threads of a GPU, and a fixed order of sums."""


@wp.kernel
def _move_origins(
    # model
    bone_parents_in: wp.array[int],
    joint_steps_in: wp.array2d[wp.vec3],
    # in
    rotations_in: wp.array2d[wp.mat33],
    # out
    origin_steps_out: wp.array3d[wp.vec3],
):
    """One shape unknown of one row: how all bone origins move with it, palm outwards."""
    rowid, unknown = wp.tid()
    for bone in range(bone_parents_in.shape[0]):
        parent = bone_parents_in[bone]
        step = wp.vec3(0.0)
        if parent >= 0:
            step = (
                origin_steps_out[rowid, parent, unknown]
                + rotations_in[rowid, parent] @ joint_steps_in[bone, unknown]
            )
        origin_steps_out[rowid, bone, unknown] = step


@wp.kernel
def _shape_rows(
    # model
    weight_bones_in: wp.array2d[int],
    weights_in: wp.array2d[float],
    vertex_steps_in: wp.array3d[wp.vec3],
    # in
    rotations_in: wp.array2d[wp.mat33],
    origin_steps_in: wp.array3d[wp.vec3],
    matches_in: wp.array2d[int],
    rows_in: wp.array2d[vec11],
    chains_in: wp.array2d[int],
    directions: int,
    # out
    shape_rows_out: wp.array3d[float],
):
    """One residual of one row: its derivative by every shape unknown."""
    rowid, slot = wp.tid()
    if chains_in[rowid, slot] < 0:
        return
    npoint = matches_in.shape[1] * directions
    vertid = slot - npoint
    if slot < npoint:
        vertid = matches_in[rowid, slot // directions]
    row = rows_in[rowid, slot]
    direction = wp.vec3(row[0], row[1], row[2])
    unknowns = shape_rows_out.shape[2]
    for unknown in range(unknowns):
        shape_rows_out[rowid, slot, unknown] = 0.0
    for k in range(3):
        weight = weights_in[vertid, k]
        if weight > 0.0:
            bone = weight_bones_in[vertid, k]
            turned = weight * (wp.transpose(rotations_in[rowid, bone]) @ direction)
            carried = weight * direction
            for unknown in range(unknowns):
                shape_rows_out[rowid, slot, unknown] = (
                    shape_rows_out[rowid, slot, unknown]
                    + wp.dot(turned, vertex_steps_in[vertid, k, unknown])
                    + wp.dot(carried, origin_steps_in[rowid, bone, unknown])
                )


@wp.kernel
def _accumulate_shape(
    # in
    shape_rows_in: wp.array3d[float],
    rows_in: wp.array2d[vec11],
    residuals_in: wp.array2d[float],
    chains_in: wp.array2d[int],
    # out
    sums_io: wp.array4d[float],
):
    """One shape unknown of one part of a row: its products with everything, summed in order.

    Columns: the unknowns up to its own, the gradient, then the five fingers' eleven pose unknowns.
    """
    rowid, part, unknown = wp.tid()
    unknowns = shape_rows_in.shape[2]
    parts = sums_io.shape[1]
    for column in range(sums_io.shape[3]):
        sums_io[rowid, part, unknown, column] = 0.0
    slot = part
    while slot < rows_in.shape[1]:
        chain = chains_in[rowid, slot]
        if chain >= 0:
            mine = shape_rows_in[rowid, slot, unknown]
            for other in range(unknown + 1):
                sums_io[rowid, part, unknown, other] = (
                    sums_io[rowid, part, unknown, other] + mine * shape_rows_in[rowid, slot, other]
                )
            sums_io[rowid, part, unknown, unknowns] = (
                sums_io[rowid, part, unknown, unknowns] + mine * residuals_in[rowid, slot]
            )
            row = rows_in[rowid, slot]
            first = unknowns + 1 + chain * NLOCAL
            for local in range(NLOCAL):
                sums_io[rowid, part, unknown, first + local] = (
                    sums_io[rowid, part, unknown, first + local] + mine * row[local]
                )
        slot += parts


@wp.kernel
def _join_parts(
    # in
    sums_in: wp.array4d[float],
    # out
    products_out: wp.array3d[float],
):
    """One entry of one row: the sum over its parts."""
    rowid, unknown, column = wp.tid()
    total = float(0.0)
    for part in range(sums_in.shape[1]):
        total += sums_in[rowid, part, unknown, column]
    products_out[rowid, unknown, column] = total


def shape_rows(
    bone_parents: wp.array,
    weight_bones: wp.array,
    weights: wp.array,
    joint_steps: wp.array,
    vertex_steps: wp.array,
    rotations: wp.array,
    matches: wp.array,
    rows: wp.array,
    chains: wp.array,
    *,
    directions: int,
    origin_steps: wp.array,
    shape_rows: wp.array,
) -> None:
    """Derivatives of residuals by the unknowns of the shape.

    Args:
        bone_parents: Parent of each bone, -1 for the palm, shape (nbone,).
        weight_bones: Bones that move each vertex, shape (nvert, 3).
        weights: Skinning weights, shape (nvert, 3).
        joint_steps: Derivatives of the joint origins in their parents' frames [m], shape (nbone,
            nshape) vec3.
        vertex_steps: Derivatives of the local vertices [m], shape (nvert, 3, nshape) vec3.
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        matches: Vertex of each sampled point, shape (nrow, npoint).
        rows: Weighted rows by the pose, first of points, then of vertices, shape (nrow, nslot)
            vec11.
        chains: Finger of each residual, negative for none, shape (nrow, nslot).
        directions: Residuals per point.
        origin_steps: Out: derivatives of the bone origins [m], camera frame, shape (nrow, nbone,
            nshape) vec3.
        shape_rows: Out: weighted rows by the shape where there is a residual, shape (nrow, nslot,
            nshape).
    """
    wp.launch(
        _move_origins,
        dim=(origin_steps.shape[0], origin_steps.shape[2]),
        inputs=[bone_parents, joint_steps, rotations],
        outputs=[origin_steps],
        device=origin_steps.device,
    )
    wp.launch(
        _shape_rows,
        dim=chains.shape,
        inputs=[
            weight_bones, weights, vertex_steps, rotations, origin_steps, matches, rows, chains,
            directions,
        ],
        outputs=[shape_rows],
        device=shape_rows.device,
    )  # fmt: skip


def accumulate_shape(
    shape_rows: wp.array,
    rows: wp.array,
    residuals: wp.array,
    chains: wp.array,
    *,
    sums: wp.array,
    products: wp.array,
) -> None:
    """Products of the shape's rows with themselves, with the residuals and with the pose's rows.

    Args:
        shape_rows: Weighted rows by the shape, shape (nrow, nslot, nshape).
        rows: Weighted rows by the pose, shape (nrow, nslot) vec11.
        residuals: Weighted residuals, shape (nrow, nslot).
        chains: Finger of each residual, negative for none, shape (nrow, nslot).
        sums: Scratch, shape (nrow, `PARTS`, nshape, nshape + 1 + 55).
        products: Out: lower triangle of J_s^T J_s, then J_s^T r, then J_s^T J_p of the palm and
            five angles of each finger; shape (nrow, nshape, nshape + 1 + 55).
    """
    wp.launch(
        _accumulate_shape,
        dim=sums.shape[:3],
        inputs=[shape_rows, rows, residuals, chains],
        outputs=[sums],
        device=sums.device,
    )
    wp.launch(
        _join_parts, dim=products.shape, inputs=[sums], outputs=[products], device=products.device
    )
