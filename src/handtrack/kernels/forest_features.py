"""What forests see: start poses from the points' axes, shape-indexed features, traversal (II.4.1).

Forests know right hands only. The images of left hands are looked at in a mirror: `mirror` is -1
for them, and poses then live in the mirrored camera frame.
"""

from __future__ import annotations

import warp as wp

from handtrack.kernels.se3 import pose_rotation, pose_translation

wp.set_module_options({"enable_backward": False})

NSTART = 4
"""Start poses per image: the signs of the two axes that the points leave open."""


@wp.func
def _seen_point(
    cells_in: wp.array3d[float],
    cameras_in: wp.array2d[float],
    image: int,
    row: int,
    column: int,
    mirror: float,
    centre: wp.vec3,
    radius: float,
) -> wp.vec3:
    # The point seen in a cell when it lies inside a ball, else z = 0.
    z = cells_in[image, row, column]
    if z <= 0.0 or not wp.isfinite(z):
        return wp.vec3(0.0)
    point = wp.vec3(
        mirror * (float(column) - cameras_in[image, 2]) / cameras_in[image, 0] * z,
        (float(row) - cameras_in[image, 3]) / cameras_in[image, 1] * z,
        z,
    )
    if wp.length(point - centre) > radius:
        return wp.vec3(0.0)
    return point


@wp.kernel
def _principal_starts(
    # model
    palm_points_in: wp.array2d[wp.vec3],
    middle_point: int,
    angles_in: wp.array2d[float],
    image_hand_in: wp.array[int],
    # in
    cells_in: wp.array3d[float],
    cameras_in: wp.array2d[float],
    gates_in: wp.array2d[float],
    mirror: float,
    stride: int,
    # out
    poses_out: wp.array3d[float],
):
    """One image: poses with the palm's x along the points' longest, y along their shortest axis.

    The middle knuckle lies in the points' mean (II.4.2).
    """
    image = wp.tid()
    total = wp.vec3(0.0)
    moments = wp.mat33(0.0)
    number = float(0.0)
    centre = wp.vec3(gates_in[image, 0], gates_in[image, 1], gates_in[image, 2])
    for j in range(cells_in.shape[1] // stride):
        for i in range(cells_in.shape[2] // stride):
            # In a mirror columns are counted from the other side: both see the same cells.
            column = wp.where(mirror < 0.0, cells_in.shape[2] - 1 - i * stride, i * stride)
            p = _seen_point(
                cells_in, cameras_in, image, j * stride, column, mirror, centre,
                gates_in[image, 3],
            )  # fmt: skip
            if p[2] > 0.0:
                d = p - centre
                total += d
                moments += wp.outer(d, d)
                number += 1.0
    mean = total / wp.max(number, 1.0)
    spread = moments / wp.max(number, 1.0) - wp.outer(mean, mean)
    vectors, values = wp.eig3(spread + wp.diag(wp.vec3(1.0e-9, 2.0e-9, 3.0e-9)))
    longest = int(0)
    shortest = int(0)
    for k in range(1, 3):
        if values[k] > values[longest]:
            longest = k
        if values[k] <= values[shortest]:
            shortest = k
    if longest == shortest:
        shortest = (longest + 1) % 3
    along = wp.vec3(vectors[0, longest], vectors[1, longest], vectors[2, longest])
    across = wp.vec3(vectors[0, shortest], vectors[1, shortest], vectors[2, shortest])
    hand = image_hand_in[image]
    for start in range(poses_out.shape[1]):
        x = wp.where(start % 2 == 0, 1.0, -1.0) * along
        y = wp.where(start // 2 == 0, 1.0, -1.0) * across
        rotation = wp.matrix_from_cols(x, y, wp.cross(x, y))
        place = centre + mean - rotation @ palm_points_in[hand, middle_point]
        q = wp.quat_from_matrix(rotation)
        for k in range(3):
            poses_out[image, start, k] = place[k]
            poses_out[image, start, 4 + k] = q[k]
        poses_out[image, start, 3] = q[3]
        for k in range(angles_in.shape[1]):
            poses_out[image, start, 7 + k] = angles_in[hand, k]


@wp.kernel
def _frame_parts(
    # model
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    part_bones_in: wp.array[int],
    palm_points_in: wp.array2d[wp.vec3],
    middle_point: int,
    row_hand_in: wp.array[int],
    # in
    pose_in: wp.array2d[float],
    # out
    frames_out: wp.array2d[wp.mat33],
    places_out: wp.array2d[wp.vec3],
    centres_out: wp.array[wp.vec3],
):
    """One part of one row: frame of the palm, or of a finger's root when its angles are zero."""
    rowid, part = wp.tid()
    rotation = pose_rotation(pose_in, rowid)
    place = pose_translation(pose_in, rowid)
    if part == 0:
        # The middle knuckle is about the middle of a hand.
        middle = palm_points_in[row_hand_in[rowid], middle_point]
        centres_out[rowid] = place + rotation @ middle
    bone = part_bones_in[part]
    if bone > 0:
        hand = row_hand_in[rowid]
        place = place + rotation @ bone_origins_in[hand, bone]
        rotation = rotation @ bone_rotations_in[hand, bone]
    frames_out[rowid, part] = rotation
    places_out[rowid, part] = place


@wp.kernel
def _sample_points(
    # model
    anchors_in: wp.array2d[int],
    offsets_in: wp.array2d[wp.vec3],
    # in
    row_image_in: wp.array[int],
    cells_in: wp.array3d[float],
    cameras_in: wp.array2d[float],
    centres_in: wp.array[wp.vec3],
    frames_in: wp.array2d[wp.mat33],
    places_in: wp.array2d[wp.vec3],
    vertices_in: wp.array2d[wp.vec3],
    mirror: float,
    gate_radius: float,
    depth_range: float,
    # out
    values_out: wp.array3d[float],
):
    """One reference point of one part of one row: depth seen there against the part's (Eq. II.15).

    The difference of two such values is that of the two depths. Point 0 is the part's own depth,
    so that features can also tell how far before or behind the model the surface is.
    """
    rowid, part, pointid = wp.tid()
    if pointid == 0:
        values_out[rowid, part, pointid] = 0.0
        return
    anchor = anchors_in[part, pointid]
    place = places_in[rowid, part]
    point = place
    if anchor >= 0:
        point = vertices_in[rowid, anchor]
    point = point + frames_in[rowid, part] @ offsets_in[part, pointid]
    image = row_image_in[rowid]
    value = float(depth_range)
    if point[2] > 0.02:
        u = cameras_in[image, 0] * mirror * point[0] / point[2] + cameras_in[image, 2] + 0.5
        v = cameras_in[image, 1] * point[1] / point[2] + cameras_in[image, 3] + 0.5
        # Compared as floats: a number too large for an int becomes any int.
        inside = u < float(cells_in.shape[2]) and v < float(cells_in.shape[1])
        if u >= 0.0 and v >= 0.0 and inside:
            seen = _seen_point(
                cells_in, cameras_in, image, int(v), int(u), mirror, centres_in[rowid],
                gate_radius,
            )  # fmt: skip
            if seen[2] > 0.0:
                value = wp.clamp(seen[2] - place[2], -depth_range, depth_range)
    values_out[rowid, part, pointid] = value


@wp.kernel
def _traverse_trees(
    # model
    tree_parts_in: wp.array[int],
    roots_in: wp.array[int],
    node_points_in: wp.array2d[int],
    thresholds_in: wp.array[float],
    children_in: wp.array[int],
    # in
    values_in: wp.array3d[float],
    # out
    leaves_out: wp.array2d[int],
):
    """One tree of one row: the leaf that its features lead to."""
    rowid, tree = wp.tid()
    part = tree_parts_in[tree]
    node = roots_in[tree]
    child = children_in[node]
    while child >= 0:
        difference = (
            values_in[rowid, part, node_points_in[node, 0]]
            - values_in[rowid, part, node_points_in[node, 1]]
        )
        node = child + wp.where(difference < thresholds_in[node], 0, 1)
        child = children_in[node]
    leaves_out[rowid, tree] = -1 - child


def principal_starts(
    palm_points: wp.array,
    angles: wp.array,
    image_hand: wp.array,
    cells: wp.array,
    cameras: wp.array,
    gates: wp.array,
    *,
    middle_point: int,
    mirror: float,
    stride: int,
    poses: wp.array,
) -> None:
    """Start poses of every image.

    Args:
        palm_points: Palm points in the palm's frame [m], shape (nhand, npalm) vec3.
        angles: Joint angles of the start poses [rad], shape (nhand, 21).
        image_hand: Hand in each image, shape (nimage,).
        cells: Crops [m], 0 background, infinity unknown, shape (nimage, n, n).
        cameras: fx, fy, cx, cy of the crops' grids [cells], shape (nimage, >= 4).
        gates: Ball that holds the hand, mirrored frame, shape (nimage, 4).
        middle_point: The middle finger's knuckle among the palm points.
        mirror: -1 for left hands, else 1.
        stride: Every stride-th cell in both directions is looked at.
        poses: Out: poses, mirrored frame, shape (nimage, NSTART, 28).
    """
    wp.launch(
        _principal_starts,
        dim=poses.shape[0],
        inputs=[
            palm_points, middle_point, angles, image_hand, cells, cameras, gates, mirror, stride
        ],
        outputs=[poses],
        device=poses.device,
    )  # fmt: skip


def frame_parts(
    bone_rotations: wp.array,
    bone_origins: wp.array,
    part_bones: wp.array,
    palm_points: wp.array,
    row_hand: wp.array,
    pose: wp.array,
    *,
    middle_point: int,
    frames: wp.array,
    places: wp.array,
    centres: wp.array,
) -> None:
    """Reference frames of every part, and the middle of every row's hand.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (nhand, nbone) mat33.
        bone_origins: Joint origins in the parent's frame [m], shape (nhand, nbone) vec3.
        part_bones: Bone whose root frame belongs to each part, 0 for the palm, shape (npart,).
        palm_points: Palm points in the palm's frame [m], shape (nhand, npalm) vec3.
        row_hand: Hand of each row, shape (nrow,).
        pose: Poses, shape (nrow, 28).
        middle_point: The middle finger's knuckle among the palm points.
        frames: Out: rotations to the camera's frame, shape (nrow, npart) mat33.
        places: Out: origins [m], shape (nrow, npart) vec3.
        centres: Out: middle knuckles [m], shape (nrow,) vec3.
    """
    wp.launch(
        _frame_parts,
        dim=frames.shape,
        inputs=[
            bone_rotations, bone_origins, part_bones, palm_points, middle_point, row_hand, pose
        ],
        outputs=[frames, places, centres],
        device=frames.device,
    )  # fmt: skip


def sample_points(
    anchors: wp.array,
    offsets: wp.array,
    row_image: wp.array,
    cells: wp.array,
    cameras: wp.array,
    centres: wp.array,
    frames: wp.array,
    places: wp.array,
    vertices: wp.array,
    *,
    mirror: float,
    gate_radius: float,
    depth_range: float,
    values: wp.array,
) -> None:
    """Depth seen at every reference point, against its part's origin.

    Args:
        anchors: Vertex of each reference point, -1 for the frame's origin (Eq. II.14), shape
            (npart, npoint).
        offsets: Offset of each point from it in the part's frame [m], shape (npart, npoint) vec3.
        row_image: Image of each row, shape (nrow,).
        cells: Crops [m], shape (nimage, n, n).
        cameras: fx, fy, cx, cy of the crops' grids [cells], shape (nimage, >= 4).
        centres: Middle of each row's hand [m], shape (nrow,) vec3.
        frames: Rotations of the parts' frames, shape (nrow, npart) mat33.
        places: Their origins [m], shape (nrow, npart) vec3.
        vertices: Vertices that points hang on [m], shape (nrow, nanchor) vec3.
        mirror: -1 for left hands, else 1.
        gate_radius: What is farther from that middle is background [m].
        depth_range: Values are clipped to so much; background counts as that far behind [m].
        values: Out: depths [m], shape (nrow, npart, npoint).
    """
    wp.launch(
        _sample_points,
        dim=values.shape,
        inputs=[
            anchors, offsets, row_image, cells, cameras, centres, frames, places, vertices,
            mirror, gate_radius, depth_range,
        ],
        outputs=[values],
        device=values.device,
    )  # fmt: skip


def traverse_trees(
    tree_parts: wp.array,
    roots: wp.array,
    node_points: wp.array,
    thresholds: wp.array,
    children: wp.array,
    values: wp.array,
    *,
    leaves: wp.array,
) -> None:
    """Leaf that every row reaches in every tree.

    Args:
        tree_parts: Part that each tree belongs to, shape (ntree,).
        roots: Root node of each tree, shape (ntree,).
        node_points: The two reference points of each node, shape (nnode, 2).
        thresholds: Smaller differences go left [m], shape (nnode,).
        children: Left child, the right one follows it; -1 - leaf in a leaf; shape (nnode,).
        values: Depths at the reference points [m], shape (nrow, npart, npoint).
        leaves: Out: leaf numbers, shape (nrow, ntree).
    """
    wp.launch(
        _traverse_trees,
        dim=leaves.shape,
        inputs=[tree_parts, roots, node_points, thresholds, children, values],
        outputs=[leaves],
        device=leaves.device,
    )
