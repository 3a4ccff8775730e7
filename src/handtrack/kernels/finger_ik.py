"""Inverse kinematics of single fingers: joint angles that put three joints where they belong."""

from __future__ import annotations

import warp as wp

from handtrack.kernels.se3 import axis_rotation

wp.set_module_options({"enable_backward": False})

vec5 = wp.types.vector(length=5, dtype=float)
mat55 = wp.types.matrix(shape=(5, 5), dtype=float)
mat3_3 = wp.types.matrix(shape=(3, 3), dtype=float)


@wp.func
def _chain_points(
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    tip_offsets_in: wp.array2d[wp.vec3],
    angle_axes_in: wp.array2d[wp.vec3],
    bone_angles_in: wp.array2d[int],
    hand: int,
    finger: int,
    angles: vec5,
):
    # Joints (rows of the first matrix), origins of the three bones and axes of the angles, all in
    # the frame that the finger's root has at zero angles.
    base = 1 + 3 * finger
    points = mat3_3()
    origins = mat3_3()
    axes = wp.matrix(0.0, shape=(5, 3))
    rotation = wp.identity(n=3, dtype=float)
    place = wp.vec3(0.0)
    used = int(0)
    for k in range(3):
        bone = base + k
        if k > 0:
            rotation = rotation @ bone_rotations_in[hand, bone]
        for axis in range(3):
            origins[k, axis] = place[axis]
        for slot in range(2):
            angle = bone_angles_in[bone, slot]
            if angle >= 0:
                axis_ = angle_axes_in[hand, angle]
                world = rotation @ axis_
                for axis in range(3):
                    axes[used, axis] = world[axis]
                rotation = rotation @ axis_rotation(axis_, angles[used])
                used += 1
        end = tip_offsets_in[hand, finger]
        if k < 2:
            end = bone_origins_in[hand, bone + 1]
        place = place + rotation @ end
        for axis in range(3):
            points[k, axis] = place[axis]
    return points, origins, axes


@wp.func
def _angle_bone(finger: int, angle: int) -> int:
    # Which of a finger's three bones an angle moves: 0 0 1 1 2 for the thumb, else 0 0 1 2.
    if finger == 0:
        return angle // 2
    return wp.max(angle - 1, 0)


@wp.kernel
def _place_fingers(
    # model
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    tip_offsets_in: wp.array2d[wp.vec3],
    angle_axes_in: wp.array2d[wp.vec3],
    bone_angles_in: wp.array2d[int],
    row_hand_in: wp.array[int],
    # in
    pose_in: wp.array2d[float],
    # out
    points_out: wp.array3d[wp.vec3],
):
    """One finger of one row: its three outer joints in the frame of its root at zero angles."""
    rowid, finger = wp.tid()
    first = wp.where(finger == 0, 7, 8 + 4 * finger)
    count = wp.where(finger == 0, 5, 4)
    angles = vec5()
    for k in range(count):
        angles[k] = pose_in[rowid, first + k]
    points, _origins, _axes = _chain_points(
        bone_rotations_in, bone_origins_in, tip_offsets_in, angle_axes_in, bone_angles_in,
        row_hand_in[rowid], finger, angles,
    )  # fmt: skip
    for k in range(3):
        points_out[rowid, finger, k] = wp.vec3(points[k, 0], points[k, 1], points[k, 2])


@wp.kernel
def _bend_fingers(
    # model
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    tip_offsets_in: wp.array2d[wp.vec3],
    angle_axes_in: wp.array2d[wp.vec3],
    bone_angles_in: wp.array2d[int],
    limits_in: wp.array2d[float],
    row_hand_in: wp.array[int],
    # in
    targets_in: wp.array3d[wp.vec3],
    iterations: int,
    damping: float,
    # out
    pose_io: wp.array2d[float],
):
    """One finger of one row: damped Gauss-Newton on its joints, kept within the limits."""
    rowid, finger = wp.tid()
    hand = row_hand_in[rowid]
    first = wp.where(finger == 0, 7, 8 + 4 * finger)
    count = wp.where(finger == 0, 5, 4)
    angles = vec5()
    for k in range(count):
        angles[k] = pose_io[rowid, first + k]
    for _iteration in range(iterations):
        points, origins, axes = _chain_points(
            bone_rotations_in, bone_origins_in, tip_offsets_in, angle_axes_in, bone_angles_in,
            hand, finger, angles,
        )  # fmt: skip
        system = mat55()
        slope = vec5()
        for joint in range(3):
            p = wp.vec3(points[joint, 0], points[joint, 1], points[joint, 2])
            gap = targets_in[rowid, finger, joint] - p
            columns = wp.matrix(0.0, shape=(5, 3))
            for k in range(count):
                bone = _angle_bone(finger, k)
                if bone <= joint:
                    arm = p - wp.vec3(origins[bone, 0], origins[bone, 1], origins[bone, 2])
                    move = wp.cross(wp.vec3(axes[k, 0], axes[k, 1], axes[k, 2]), arm)
                    for axis in range(3):
                        columns[k, axis] = move[axis]
                    slope[k] = slope[k] + wp.dot(move, gap)
            for a in range(count):
                for b in range(count):
                    total = float(0.0)
                    for axis in range(3):
                        total += columns[a, axis] * columns[b, axis]
                    system[a, b] = system[a, b] + total
        for k in range(5):
            system[k, k] = system[k, k] + damping
        # An angle that would leave its limits stays, and the others are told.
        for k in range(count):
            low = limits_in[first - 7 + k, 0]
            high = limits_in[first - 7 + k, 1]
            if (angles[k] <= low and slope[k] < 0.0) or (angles[k] >= high and slope[k] > 0.0):
                for m in range(count):
                    system[k, m] = float(0.0)
                    system[m, k] = float(0.0)
                system[k, k] = float(1.0)
                slope[k] = float(0.0)
        # Cholesky in place, then both substitutions.
        for j in range(count):
            pivot = system[j, j]
            for m in range(j):
                pivot -= system[j, m] * system[j, m]
            pivot = wp.sqrt(wp.max(pivot, 1.0e-12))
            system[j, j] = pivot
            for i in range(j + 1, count):
                entry = system[i, j]
                for m in range(j):
                    entry -= system[i, m] * system[j, m]
                system[i, j] = entry / pivot
        for i in range(count):
            value = slope[i]
            for m in range(i):
                value -= system[i, m] * slope[m]
            slope[i] = value / system[i, i]
        for back in range(count):
            i = count - 1 - back
            value = slope[i]
            for m in range(i + 1, count):
                value -= system[m, i] * slope[m]
            slope[i] = value / system[i, i]
        for k in range(count):
            low = limits_in[first - 7 + k, 0]
            high = limits_in[first - 7 + k, 1]
            angles[k] = wp.clamp(angles[k] + wp.clamp(slope[k], -0.5, 0.5), low, high)
    for k in range(count):
        pose_io[rowid, first + k] = angles[k]


def place_fingers(
    bone_rotations: wp.array,
    bone_origins: wp.array,
    tip_offsets: wp.array,
    angle_axes: wp.array,
    bone_angles: wp.array,
    row_hand: wp.array,
    pose: wp.array,
    *,
    points: wp.array,
) -> None:
    """Outer joints of every finger in the frame of its root.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (nhand, nbone) mat33.
        bone_origins: Joint origins in the parent's frame [m], shape (nhand, nbone) vec3.
        tip_offsets: Fingertips in the frames of the distal bones [m], shape (nhand, 5) vec3.
        angle_axes: Axis of each angle in its bone's frame, shape (nhand, 21) vec3.
        bone_angles: Angles that move each bone, outermost first, -1 for none, shape (nbone, 2).
        row_hand: Hand of each row, shape (nrow,).
        pose: Poses, shape (nrow, 28).
        points: Out: second joint, third joint and tip [m], shape (nrow, 5, 3) vec3.
    """
    wp.launch(
        _place_fingers,
        dim=points.shape[:2],
        inputs=[
            bone_rotations, bone_origins, tip_offsets, angle_axes, bone_angles, row_hand, pose
        ],
        outputs=[points],
        device=points.device,
    )  # fmt: skip


def bend_fingers(
    bone_rotations: wp.array,
    bone_origins: wp.array,
    tip_offsets: wp.array,
    angle_axes: wp.array,
    bone_angles: wp.array,
    limits: wp.array,
    row_hand: wp.array,
    targets: wp.array,
    *,
    iterations: int,
    damping: float,
    pose: wp.array,
) -> None:
    """Joint angles that bring the fingers' joints to their targets.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (nhand, nbone) mat33.
        bone_origins: Joint origins in the parent's frame [m], shape (nhand, nbone) vec3.
        tip_offsets: Fingertips in the frames of the distal bones [m], shape (nhand, 5) vec3.
        angle_axes: Axis of each angle in its bone's frame, shape (nhand, 21) vec3.
        bone_angles: Angles that move each bone, outermost first, -1 for none, shape (nbone, 2).
        limits: Lower and upper joint limits [rad], shape (21, 2).
        row_hand: Hand of each row, shape (nrow,).
        targets: Joints in the roots' frames [m], shape (nrow, 5, 3) vec3.
        iterations: Gauss-Newton steps.
        damping: Added to the diagonal [m^2/rad^2].
        pose: In and out: poses, shape (nrow, 28).
    """
    wp.launch(
        _bend_fingers,
        dim=targets.shape[:2],
        inputs=[
            bone_rotations, bone_origins, tip_offsets, angle_axes, bone_angles, limits, row_hand,
            targets, iterations, damping,
        ],
        outputs=[pose],
        device=pose.device,
    )  # fmt: skip
