"""Linear blend skinning of vertices and normals (Eq. II.9), one vertex of one row per thread."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _skin_vertices(
    # model
    weight_bones_in: wp.array2d[int],
    weights_in: wp.array2d[float],
    local_vertices_in: wp.array3d[wp.vec3],
    local_normals_in: wp.array3d[wp.vec3],
    row_hand_in: wp.array[int],
    # in
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    # out
    vertices_out: wp.array2d[wp.vec3],
    normals_out: wp.array2d[wp.vec3],
):
    """One vertex of one row: blended position and unit normal."""
    rowid, vertid = wp.tid()
    hand = row_hand_in[rowid]
    point = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    for slot in range(3):
        weight = weights_in[vertid, slot]
        if weight > 0.0:
            bone = weight_bones_in[vertid, slot]
            rotation = rotations_in[rowid, bone]
            local = local_vertices_in[hand, vertid, slot]
            point += weight * (rotation @ local + origins_in[rowid, bone])
            normal += weight * (rotation @ local_normals_in[hand, vertid, slot])
    vertices_out[rowid, vertid] = point
    normals_out[rowid, vertid] = wp.normalize(normal)


def skin_vertices(
    weight_bones: wp.array,
    weights: wp.array,
    local_vertices: wp.array,
    local_normals: wp.array,
    row_hand: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    vertices: wp.array,
    normals: wp.array,
) -> None:
    """Skinned vertices and normals of every row.

    Args:
        weight_bones: Bones that move each vertex, shape (nvert, 3).
        weights: Skinning weights, shape (nvert, 3).
        local_vertices: Vertices in the frames of those bones [m], shape (nhand, nvert, 3) vec3.
        local_normals: Normals in the frames of those bones, shape (nhand, nvert, 3) vec3.
        row_hand: Hand of each row, shape (nrow,).
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        vertices: Out: vertices [m], camera frame, shape (nrow, nvert) vec3.
        normals: Out: unit normals, camera frame, shape (nrow, nvert) vec3.
    """
    wp.launch(
        _skin_vertices,
        dim=vertices.shape,
        inputs=[
            weight_bones, weights, local_vertices, local_normals, row_hand, rotations, origins
        ],
        outputs=[vertices, normals],
        device=vertices.device,
    )  # fmt: skip
