"""Terms that know the pose but not the image: limits, smoothness, Gaussian prior, self-collision.

Each adds its J^T J and J^T r to the 27 x 27 system of a row and its energy to the row's costs.
"""

from __future__ import annotations

import warp as wp

from handtrack.kernels.se3 import pose_rotation

wp.set_module_options({"enable_backward": False})


@wp.func
def _log_rotation(r: wp.mat33) -> wp.vec3:
    # Rotation vector of a rotation of less than half a turn.
    axis = wp.vec3(r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    s = 0.5 * wp.length(axis)
    c = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
    angle = wp.atan2(s, c)
    k = float(0.5)
    if s > 1.0e-5:
        k = 0.5 * angle / s
    return k * axis


@wp.kernel
def _add_pose_terms(
    # model
    limits_in: wp.array2d[float],
    prior_mean_in: wp.array[float],
    prior_precision_in: wp.array2d[float],
    row_hand_in: wp.array[int],
    # in
    pose_in: wp.array2d[float],
    reference_in: wp.array2d[float],
    smooth_in: wp.array2d[float],
    limit_weight: float,
    prior_weight: float,
    first_cost: int,
    # out
    hessian_io: wp.array3d[float],
    gradient_io: wp.array2d[float],
    costs_out: wp.array2d[float],
):
    """One unknown of one row: smoothness (II.24), joint limits (II.25), Gaussian prior."""
    rowid, i = wp.tid()
    smooth = smooth_in[row_hand_in[rowid], i]
    cost = float(0.0)
    h = smooth
    moved = float(0.0)
    if i < 3:
        moved = pose_in[rowid, i] - reference_in[rowid, i]
    elif i < 6:
        turn = _log_rotation(
            wp.transpose(pose_rotation(reference_in, rowid)) @ pose_rotation(pose_in, rowid)
        )
        moved = turn[i - 3]
    else:
        moved = pose_in[rowid, i + 1] - reference_in[rowid, i + 1]
    g = smooth * moved
    cost += smooth * moved * moved
    if i >= 6:
        a = i - 6
        angle = pose_in[rowid, i + 1]
        over = wp.min(angle - limits_in[a, 0], 0.0) + wp.max(angle - limits_in[a, 1], 0.0)
        if over != 0.0:
            h += limit_weight
            g += limit_weight * over
            cost += limit_weight * over * over
        if prior_weight > 0.0:
            pull = float(0.0)
            for b in range(prior_mean_in.shape[0]):
                p = prior_weight * prior_precision_in[a, b]
                pull += p * (pose_in[rowid, 7 + b] - prior_mean_in[b])
                hessian_io[rowid, i, 6 + b] = hessian_io[rowid, i, 6 + b] + p
            g += pull
            cost += pull * (angle - prior_mean_in[a])
    hessian_io[rowid, i, i] = hessian_io[rowid, i, i] + h
    gradient_io[rowid, i] = gradient_io[rowid, i] + g
    costs_out[rowid, first_cost + i] = cost


@wp.kernel
def _place_spheres(
    # model
    sphere_bones_in: wp.array[int],
    sphere_centres_in: wp.array2d[wp.vec3],
    row_hand_in: wp.array[int],
    # in
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    # out
    centres_out: wp.array2d[wp.vec3],
):
    """One collision sphere of one row: its centre in the camera frame."""
    rowid, sphere = wp.tid()
    bone = sphere_bones_in[sphere]
    local = sphere_centres_in[row_hand_in[rowid], sphere]
    centres_out[rowid, sphere] = rotations_in[rowid, bone] @ local + origins_in[rowid, bone]


@wp.func
def _angle_range(bone: int) -> wp.vec2i:
    # First joint angle of a finger bone's chain and one past the last angle that moves the bone.
    first = int(0)
    last = int(0)
    if bone >= 1 and bone <= 3:
        last = wp.min(2 * bone, 5)
    elif bone > 3:
        first = 5 + 4 * ((bone - 4) // 3)
        last = first + 2 + (bone - 4) % 3
    return wp.vec2i(first, last)


@wp.kernel
def _add_collisions(
    # model
    sphere_bones_in: wp.array[int],
    sphere_radii_in: wp.array2d[float],
    pairs_in: wp.array2d[int],
    angle_bones_in: wp.array[int],
    row_hand_in: wp.array[int],
    # in
    centres_in: wp.array2d[wp.vec3],
    origins_in: wp.array2d[wp.vec3],
    axes_in: wp.array2d[wp.vec3],
    weight: float,
    cost_slot: int,
    # out
    hessian_io: wp.array3d[float],
    gradient_io: wp.array2d[float],
    costs_out: wp.array2d[float],
):
    """One row: push apart the spheres of different fingers that overlap."""
    rowid = wp.tid()
    hand = row_hand_in[rowid]
    cost = float(0.0)
    for pair in range(pairs_in.shape[0]):
        sa = pairs_in[pair, 0]
        sb = pairs_in[pair, 1]
        ca = centres_in[rowid, sa]
        cb = centres_in[rowid, sb]
        reach = sphere_radii_in[hand, sa] + sphere_radii_in[hand, sb]
        gap = ca - cb
        squared = wp.length_sq(gap)
        if squared < reach * reach and squared > 1.0e-12:
            distance = wp.sqrt(squared)
            over = reach - distance
            cost += weight * over * over
            n = gap / distance
            ra = _angle_range(sphere_bones_in[sa])
            rb = _angle_range(sphere_bones_in[sb])
            # Only joint angles move the two spheres against each other: at most ten entries.
            for i in range(ra[1] - ra[0] + rb[1] - rb[0]):
                ji = _pair_entry(i, ra, rb, ca, cb, n, rowid, origins_in, axes_in, angle_bones_in)
                ai = 6 + _pair_angle(i, ra, rb)
                gradient_io[rowid, ai] = gradient_io[rowid, ai] - weight * over * ji
                for j in range(ra[1] - ra[0] + rb[1] - rb[0]):
                    jj = _pair_entry(
                        j, ra, rb, ca, cb, n, rowid, origins_in, axes_in, angle_bones_in
                    )
                    aj = 6 + _pair_angle(j, ra, rb)
                    hessian_io[rowid, ai, aj] = hessian_io[rowid, ai, aj] + weight * ji * jj
    costs_out[rowid, cost_slot] = cost


@wp.func
def _pair_angle(i: int, ra: wp.vec2i, rb: wp.vec2i) -> int:
    # Joint angle behind entry i of a pair's derivative: the first sphere's angles, then the
    # second's.
    na = ra[1] - ra[0]
    return wp.where(i < na, ra[0] + i, rb[0] + i - na)


@wp.func
def _pair_entry(
    i: int,
    ra: wp.vec2i,
    rb: wp.vec2i,
    ca: wp.vec3,
    cb: wp.vec3,
    n: wp.vec3,
    rowid: int,
    origins_in: wp.array2d[wp.vec3],
    axes_in: wp.array2d[wp.vec3],
    angle_bones_in: wp.array[int],
) -> float:
    # Derivative of the distance between the two centres by the pair's i-th angle.
    angle = _pair_angle(i, ra, rb)
    axis = axes_in[rowid, angle]
    origin = origins_in[rowid, angle_bones_in[angle]]
    d = float(0.0)
    if i < ra[1] - ra[0]:
        d = wp.dot(n, wp.cross(axis, ca - origin))
    else:
        d = -wp.dot(n, wp.cross(axis, cb - origin))
    return d


def add_pose_terms(
    limits: wp.array,
    prior_mean: wp.array,
    prior_precision: wp.array,
    row_hand: wp.array,
    pose: wp.array,
    reference: wp.array,
    smooth: wp.array,
    *,
    limit_weight: float,
    prior_weight: float,
    first_cost: int,
    hessian: wp.array,
    gradient: wp.array,
    costs: wp.array,
) -> None:
    """Add smoothness, joint limits and the Gaussian prior to every row's system.

    Args:
        limits: Joint limits [rad], shape (21, 2).
        prior_mean: Mean joint angles [rad], shape (21,).
        prior_precision: Inverse covariance of the joint angles [1/rad^2], shape (21, 21).
        row_hand: Hand of each row, shape (nrow,).
        pose: Poses, shape (nrow, 28).
        reference: Poses that smoothness pulls to, shape (nrow, 28).
        smooth: Smoothness weight of each unknown, shape (nhand, 27).
        limit_weight: Weight of the squared excess over a limit.
        prior_weight: Weight of the Gaussian prior, 0 switches it off.
        first_cost: First of the 27 cost slots written.
        hessian: In and out: J^T J, shape (nrow, 27, 27).
        gradient: In and out: J^T r, shape (nrow, 27).
        costs: Out: energies, shape (nrow, ncost).
    """
    wp.launch(
        _add_pose_terms,
        dim=gradient.shape,
        inputs=[
            limits, prior_mean, prior_precision, row_hand, pose, reference, smooth,
            limit_weight, prior_weight, first_cost,
        ],
        outputs=[hessian, gradient, costs],
        device=pose.device,
    )  # fmt: skip


def add_collisions(
    sphere_bones: wp.array,
    sphere_centres: wp.array,
    sphere_radii: wp.array,
    pairs: wp.array,
    angle_bones: wp.array,
    row_hand: wp.array,
    rotations: wp.array,
    origins: wp.array,
    axes: wp.array,
    *,
    weight: float,
    cost_slot: int,
    centres: wp.array,
    hessian: wp.array,
    gradient: wp.array,
    costs: wp.array,
) -> None:
    """Add the self-collision of spheres to every row's system.

    Args:
        sphere_bones: Bone of each sphere, shape (nsphere,).
        sphere_centres: Centres in the bones' frames [m], shape (nhand, nsphere) vec3.
        sphere_radii: Radii [m], shape (nhand, nsphere).
        pairs: Pairs of spheres that may not overlap, shape (npair, 2).
        angle_bones: Bone that each joint angle moves, shape (21,).
        row_hand: Hand of each row, shape (nrow,).
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        axes: Axes of the angles, shape (nrow, 21) vec3.
        weight: Weight of the squared overlap.
        cost_slot: Cost slot written.
        centres: Scratch: centres in the camera frame, shape (nrow, nsphere) vec3.
        hessian: In and out: J^T J, shape (nrow, 27, 27).
        gradient: In and out: J^T r, shape (nrow, 27).
        costs: Out: energies, shape (nrow, ncost).
    """
    wp.launch(
        _place_spheres,
        dim=centres.shape,
        inputs=[sphere_bones, sphere_centres, row_hand, rotations, origins],
        outputs=[centres],
        device=centres.device,
    )
    wp.launch(
        _add_collisions,
        dim=hessian.shape[0],
        inputs=[
            sphere_bones, sphere_radii, pairs, angle_bones, row_hand,
            centres, origins, axes, weight, cost_slot,
        ],
        outputs=[hessian, gradient, costs],
        device=centres.device,
    )  # fmt: skip
