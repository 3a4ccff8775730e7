"""Forward kinematics of the hand, one row per thread (Eq. II.8's T_j)."""

from __future__ import annotations

import warp as wp

from handtrack.kernels.se3 import axis_rotation, pose_rotation, pose_translation

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _pose_bones(
    # model
    bone_rotations_in: wp.array2d[wp.mat33],
    bone_origins_in: wp.array2d[wp.vec3],
    bone_parents_in: wp.array[int],
    bone_angles_in: wp.array2d[int],
    angle_axes_in: wp.array2d[wp.vec3],
    row_hand_in: wp.array[int],
    # in
    pose_in: wp.array2d[float],
    # out
    rotations_out: wp.array2d[wp.mat33],
    origins_out: wp.array2d[wp.vec3],
    axes_out: wp.array2d[wp.vec3],
):
    """One row: bone frames in the camera frame and the world axes of the joint angles."""
    rowid = wp.tid()
    hand = row_hand_in[rowid]
    if hand < 0:
        return
    rotations_out[rowid, 0] = pose_rotation(pose_in, rowid)
    origins_out[rowid, 0] = pose_translation(pose_in, rowid)
    for bone in range(1, bone_parents_in.shape[0]):
        parent = bone_parents_in[bone]
        parent_rotation = rotations_out[rowid, parent]
        rotation = parent_rotation @ bone_rotations_in[hand, bone]
        for slot in range(2):
            angle = bone_angles_in[bone, slot]
            if angle >= 0:
                axis = angle_axes_in[hand, angle]
                axes_out[rowid, angle] = rotation @ axis
                rotation = rotation @ axis_rotation(axis, pose_in[rowid, 7 + angle])
        rotations_out[rowid, bone] = rotation
        origins_out[rowid, bone] = (
            origins_out[rowid, parent] + parent_rotation @ bone_origins_in[hand, bone]
        )


def pose_bones(
    bone_rotations: wp.array,
    bone_origins: wp.array,
    bone_parents: wp.array,
    bone_angles: wp.array,
    angle_axes: wp.array,
    row_hand: wp.array,
    pose: wp.array,
    *,
    rotations: wp.array,
    origins: wp.array,
    axes: wp.array,
) -> None:
    """Bone frames of every row.

    Args:
        bone_rotations: Rotation from bone to parent at zero angles, shape (nhand, nbone) mat33.
        bone_origins: Joint origins in the parent's frame [m], shape (nhand, nbone) vec3.
        bone_parents: Parent of each bone, shape (nbone,); parents come before children.
        bone_angles: Angles that move each bone, outermost first, -1 for none, shape (nbone, 2).
        angle_axes: Axis of each angle in its bone's frame, shape (nhand, nangle) vec3.
        row_hand: Hand of each row, -1 for rows to leave out, shape (nrow,).
        pose: Poses, shape (nrow, nq).
        rotations: Out: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Out: bone origins [m], camera frame, shape (nrow, nbone) vec3.
        axes: Out: unit axes of the angles, camera frame, shape (nrow, nangle) vec3.
    """
    wp.launch(
        _pose_bones,
        dim=pose.shape[0],
        inputs=[
            bone_rotations,
            bone_origins,
            bone_parents,
            bone_angles,
            angle_axes,
            row_hand,
            pose,
        ],
        outputs=[rotations, origins, axes],
        device=pose.device,
    )
