"""From leaves to poses: votes for the palm, their modes, medians for fingers (II.4.2, II.4.3)."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_TREES = wp.constant(64)
"""Most trees of one part whose median is taken."""

vec_trees = wp.types.vector(length=64, dtype=float)


@wp.kernel
def _join_points(
    # model
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    palm_points_in: wp.array2d[wp.vec3],
    row_hand_in: wp.array[int],
    # in
    finger_points_in: wp.array3d[wp.vec3],
    # out
    points_out: wp.array2d[wp.vec3],
):
    """One point of one row in the palm's frame: those of the palm, then three of each finger."""
    rowid, k = wp.tid()
    hand = row_hand_in[rowid]
    palm = palm_points_in.shape[1]
    if k < palm:
        points_out[rowid, k] = palm_points_in[hand, k]
    else:
        finger = (k - palm) // 3
        base = 1 + 3 * finger
        points_out[rowid, k] = (
            bone_origins_in[hand, base]
            + bone_rotations_in[hand, base] @ finger_points_in[rowid, finger, (k - palm) % 3]
        )


@wp.kernel
def _cast_votes(
    # model
    updates_in: wp.array3d[wp.vec3],
    leaf_weights_in: wp.array2d[float],
    # in
    row_group_in: wp.array[int],
    row_slot_in: wp.array[int],
    points_in: wp.array2d[wp.vec3],
    frames_in: wp.array2d[wp.mat33],
    places_in: wp.array2d[wp.vec3],
    leaves_in: wp.array2d[int],
    tree_weights_in: wp.array2d[float],
    # out
    votes_out: wp.array3d[wp.vec3],
    weights_out: wp.array2d[float],
):
    """One tree of one row: where the modes of its leaf put the points, camera frame (Eq. II.17)."""
    rowid, tree = wp.tid()
    group = row_group_in[rowid]
    leaf = leaves_in[rowid, tree]
    modes = updates_in.shape[1]
    first = (row_slot_in[rowid] * leaves_in.shape[1] + tree) * modes
    for mode in range(modes):
        for k in range(updates_in.shape[2]):
            local = points_in[rowid, k] + updates_in[leaf, mode, k]
            votes_out[group, first + mode, k] = frames_in[rowid, 0] @ local + places_in[rowid, 0]
        weights_out[group, first + mode] = (
            tree_weights_in[rowid, tree] * leaf_weights_in[leaf, mode]
        )


@wp.func
def _vote_distance(votes_in: wp.array3d[wp.vec3], group: int, a: int, b: int, far: float) -> float:
    # Mean distance of two votes' points; stops early when it is beyond `far`.
    count = votes_in.shape[2]
    total = float(0.0)
    limit = far * float(count)
    for k in range(count):
        total += wp.length(votes_in[group, a, k] - votes_in[group, b, k])
        if total > limit:
            return far + 1.0
    return total / float(count)


@wp.kernel
def _weigh_votes(
    # in
    votes_in: wp.array3d[wp.vec3],
    weights_in: wp.array2d[float],
    radius: float,
    # out
    densities_out: wp.array2d[float],
):
    """One vote of one group: weight of the votes around it."""
    group, vote = wp.tid()
    density = float(0.0)
    if weights_in[group, vote] > 0.0:
        for other in range(votes_in.shape[1]):
            if weights_in[group, other] > 0.0:
                d = _vote_distance(votes_in, group, vote, other, radius)
                if d < radius:
                    density += weights_in[group, other] * (1.0 - d * d / (radius * radius))
    densities_out[group, vote] = density


@wp.kernel
def _pick_modes(
    # in
    votes_in: wp.array3d[wp.vec3],
    weights_in: wp.array2d[float],
    radius: float,
    # out
    densities_io: wp.array2d[float],
    modes_out: wp.array3d[wp.vec3],
    mode_weights_out: wp.array2d[float],
):
    """One group: means around the densest votes, one after the other; weight 0 for none left."""
    group = wp.tid()
    for mode in range(modes_out.shape[1]):
        best = int(0)
        for vote in range(votes_in.shape[1]):
            if densities_io[group, vote] > densities_io[group, best]:
                best = vote
        mode_weights_out[group, mode] = densities_io[group, best]
        if densities_io[group, best] <= 0.0:
            # Nothing left: the first mode again, so that the row holds a pose; zeros without one.
            for k in range(votes_in.shape[2]):
                if mode == 0:
                    modes_out[group, 0, k] = wp.vec3(0.0)
                modes_out[group, mode, k] = modes_out[group, 0, k]
        else:
            for k in range(votes_in.shape[2]):
                modes_out[group, mode, k] = wp.vec3(0.0)
            total = float(0.0)
            for vote in range(votes_in.shape[1]):
                weight = weights_in[group, vote]
                if weight > 0.0:
                    d = _vote_distance(votes_in, group, best, vote, radius)
                    if d < radius:
                        share = weight * (1.0 - d * d / (radius * radius))
                        total += share
                        for k in range(votes_in.shape[2]):
                            modes_out[group, mode, k] = (
                                modes_out[group, mode, k] + share * votes_in[group, vote, k]
                            )
                        densities_io[group, vote] = 0.0
            densities_io[group, best] = 0.0
            for k in range(votes_in.shape[2]):
                modes_out[group, mode, k] = modes_out[group, mode, k] / total


@wp.kernel
def _lay_palms(
    # model
    palm_points_in: wp.array2d[wp.vec3],
    angles_in: wp.array2d[float],
    row_hand_in: wp.array[int],
    # in
    modes_in: wp.array3d[wp.vec3],
    # out
    pose_out: wp.array2d[float],
):
    """One row: the palm laid on its points by least squares (Kabsch), start angles."""
    rowid = wp.tid()
    per_group = modes_in.shape[1]
    group = rowid // per_group
    mode = rowid % per_group
    hand = row_hand_in[rowid]
    count = palm_points_in.shape[1]
    source = wp.vec3(0.0)
    goal = wp.vec3(0.0)
    for k in range(count):
        source += palm_points_in[hand, k]
        goal += modes_in[group, mode, k]
    source = source / float(count)
    goal = goal / float(count)
    cross = wp.mat33(0.0)
    for k in range(count):
        cross += wp.outer(modes_in[group, mode, k] - goal, palm_points_in[hand, k] - source)
    # svd3 gives proper rotations and puts the sign into the last singular value.
    u, _s, v = wp.svd3(cross)
    rotation = u @ wp.transpose(v)
    place = goal - rotation @ source
    q = wp.quat_from_matrix(rotation)
    for k in range(3):
        pose_out[rowid, k] = place[k]
        pose_out[rowid, 4 + k] = q[k]
    pose_out[rowid, 3] = q[3]
    for k in range(angles_in.shape[1]):
        pose_out[rowid, 7 + k] = angles_in[hand, k]


@wp.kernel
def _aim_fingers(
    # in
    modes_in: wp.array3d[wp.vec3],
    frames_in: wp.array2d[wp.mat33],
    places_in: wp.array2d[wp.vec3],
    # out
    targets_out: wp.array3d[wp.vec3],
):
    """One joint of one finger of one row: its voted place in the frame of the finger's root."""
    rowid, finger, k = wp.tid()
    per_group = modes_in.shape[1]
    first = modes_in.shape[2] - 3 * targets_out.shape[1]
    voted = modes_in[rowid // per_group, rowid % per_group, first + 3 * finger + k]
    targets_out[rowid, finger, k] = wp.transpose(frames_in[rowid, finger]) @ (
        voted - places_in[rowid, finger]
    )


@wp.kernel
def _median_votes(
    # model
    updates_in: wp.array3d[wp.vec3],
    # in
    leaves_in: wp.array2d[int],
    tree_weights_in: wp.array2d[float],
    trees: int,
    points_in: wp.array3d[wp.vec3],
    # out
    targets_out: wp.array3d[wp.vec3],
):
    """One joint of one part of one row, moved by the median of the trees' updates (II.4.3)."""
    rowid, part, k = wp.tid()
    target = points_in[rowid, part, k]
    for axis in range(3):
        sorted_values = vec_trees()
        count = int(0)
        for t in range(trees):
            tree = part * trees + t
            if tree_weights_in[rowid, tree] > 0.0:
                value = updates_in[leaves_in[rowid, tree], 0, k][axis]
                place = count
                while place > 0 and sorted_values[wp.max(place - 1, 0)] > value:
                    sorted_values[place] = sorted_values[place - 1]
                    place -= 1
                sorted_values[place] = value
                count += 1
        if count > 0:
            middle = 0.5 * (sorted_values[(count - 1) // 2] + sorted_values[count // 2])
            target[axis] = target[axis] + middle
    targets_out[rowid, part, k] = target


def join_points(
    bone_rotations: wp.array,
    bone_origins: wp.array,
    palm_points: wp.array,
    row_hand: wp.array,
    finger_points: wp.array,
    *,
    points: wp.array,
) -> None:
    """Points of every row in the palm's frame, as votes and updates order them.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (nhand, nbone) mat33.
        bone_origins: Joint origins in the parent's frame [m], shape (nhand, nbone) vec3.
        palm_points: Palm points in the palm's frame [m], shape (nhand, npalm) vec3.
        row_hand: Hand of each row, shape (nrow,).
        finger_points: Outer joints in the roots' frames [m], shape (nrow, 5, 3) vec3.
        points: Out: palm points, then (with more than npalm columns) finger joints [m], shape
            (nrow, npalm) or (nrow, npalm + 15) vec3.
    """
    wp.launch(
        _join_points,
        dim=points.shape,
        inputs=[bone_rotations, bone_origins, palm_points, row_hand, finger_points],
        outputs=[points],
        device=points.device,
    )


def cast_votes(
    updates: wp.array,
    leaf_weights: wp.array,
    row_group: wp.array,
    row_slot: wp.array,
    points: wp.array,
    frames: wp.array,
    places: wp.array,
    leaves: wp.array,
    tree_weights: wp.array,
    *,
    votes: wp.array,
    weights: wp.array,
) -> None:
    """Votes of all trees for the points of the palm (or of the whole hand).

    Args:
        updates: Displacements kept in the leaves [m], palm frame, shape (nleaf, nmode, npoint)
            vec3.
        leaf_weights: Share of a leaf's samples in each mode, shape (nleaf, nmode).
        row_group: Group that each row votes in, shape (nrow,).
        row_slot: Place of the row in its group, shape (nrow,).
        points: The row's points in the palm's frame [m], shape (nrow, npoint) vec3.
        frames: Palm rotations, shape (nrow, 1) mat33.
        places: Palm origins [m], shape (nrow, 1) vec3.
        leaves: Leaf of each row and tree, shape (nrow, ntree).
        tree_weights: 0 leaves a tree out, shape (nrow, ntree).
        votes: Out: voted points [m], camera frame, shape (ngroup, nvote, npoint) vec3.
        weights: Out: weight of each vote, shape (ngroup, nvote).
    """
    wp.launch(
        _cast_votes,
        dim=leaves.shape,
        inputs=[
            updates, leaf_weights, row_group, row_slot, points, frames, places, leaves,
            tree_weights,
        ],
        outputs=[votes, weights],
        device=votes.device,
    )  # fmt: skip


def pick_modes(
    votes: wp.array,
    weights: wp.array,
    *,
    radius: float,
    densities: wp.array,
    modes: wp.array,
    mode_weights: wp.array,
) -> None:
    """Modes of each group's votes, the densest first.

    Args:
        votes: Voted points [m], shape (ngroup, nvote, npoint) vec3.
        weights: Weight of each vote, shape (ngroup, nvote).
        radius: Votes closer than this on average belong together [m].
        densities: Scratch, shape (ngroup, nvote).
        modes: Out: points of the modes [m], shape (ngroup, nmode, npoint) vec3.
        mode_weights: Out: weight of each mode, 0 for none, shape (ngroup, nmode).
    """
    wp.launch(
        _weigh_votes,
        dim=densities.shape,
        inputs=[votes, weights, radius],
        outputs=[densities],
        device=votes.device,
    )
    wp.launch(
        _pick_modes,
        dim=modes.shape[0],
        inputs=[votes, weights, radius],
        outputs=[densities, modes, mode_weights],
        device=votes.device,
    )


def lay_palms(
    palm_points: wp.array,
    angles: wp.array,
    row_hand: wp.array,
    modes: wp.array,
    *,
    pose: wp.array,
) -> None:
    """Poses whose palm lies on the modes' palm points.

    Args:
        palm_points: Palm points in the palm's frame [m], shape (nhand, npalm) vec3.
        angles: Joint angles of the poses [rad], shape (nhand, 21).
        row_hand: Hand of each row, shape (nrow,).
        modes: Voted points [m], those of the palm first, shape (ngroup, nmode, npoint) vec3;
            nrow = ngroup * nmode.
        pose: Out: poses, shape (nrow, 28).
    """
    wp.launch(
        _lay_palms,
        dim=pose.shape[0],
        inputs=[palm_points, angles, row_hand, modes],
        outputs=[pose],
        device=pose.device,
    )


def aim_fingers(
    modes: wp.array,
    frames: wp.array,
    places: wp.array,
    *,
    targets: wp.array,
) -> None:
    """Voted joints of the fingers in the frames of their roots, for holistic forests.

    Args:
        modes: Voted points [m], those of the fingers last, shape (ngroup, nmode, npoint) vec3;
            nrow = ngroup * nmode.
        frames: Rotations of the roots' frames, shape (nrow, 5) mat33.
        places: Their origins [m], shape (nrow, 5) vec3.
        targets: Out: joints in the roots' frames [m], shape (nrow, 5, 3) vec3.
    """
    wp.launch(
        _aim_fingers,
        dim=targets.shape,
        inputs=[modes, frames, places],
        outputs=[targets],
        device=targets.device,
    )


def median_votes(
    updates: wp.array,
    leaves: wp.array,
    tree_weights: wp.array,
    points: wp.array,
    *,
    trees: int,
    targets: wp.array,
) -> None:
    """Joints of each finger moved by the median of its trees.

    Args:
        updates: Displacements kept in the leaves [m], root frames, shape (nleaf, 1, 3) vec3.
        leaves: Leaf of each row and tree, shape (nrow, npart * trees).
        tree_weights: 0 leaves a tree out, shape (nrow, npart * trees).
        points: Joints now, root frames [m], shape (nrow, npart, 3) vec3.
        trees: Trees per part, at most 64.
        targets: Out: moved joints [m], shape (nrow, npart, 3) vec3.
    """
    wp.launch(
        _median_votes,
        dim=targets.shape,
        inputs=[updates, leaves, tree_weights, trees, points],
        outputs=[targets],
        device=targets.device,
    )
