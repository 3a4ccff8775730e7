"""Kernel of forward kinematics against the float64 reference."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from handtrack.hand.kinematics import bone_frames
from handtrack.hand.skeleton import ANGLE_BONES, NANGLE, NBONE
from handtrack.kernels.kinematics import pose_bones
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
from oracles.device_arrays import download, poisoned, upload
from oracles.scenes import rounded

FLOAT32 = 2e-6
"""Chains of four float32 rotations, lengths below a metre."""


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_bone_frames_equal_the_reference(make_posed, device, side, bend) -> None:
    posed = make_posed(device, side=side, seed=1, bend=bend, turn=2.0)
    for row in range(posed.nrow):
        rotations, origins = bone_frames(posed.hand(row), posed.poses[row])
        np.testing.assert_allclose(download(posed.rotations)[row], rotations, atol=FLOAT32)
        np.testing.assert_allclose(download(posed.origins)[row], origins, atol=FLOAT32)


@pytest.mark.parametrize("side", ["right", "left"])
def test_axes_are_those_about_which_the_bones_turn(make_posed, device, side) -> None:
    posed = make_posed(device, side=side, seed=2, bend=1.0)
    step = 1e-6
    for row in range(posed.nrow):
        hand = posed.hand(row)
        for angle, bone in enumerate(ANGLE_BONES):
            turned = posed.poses[row].copy()
            turned[7 + angle] += step
            before = bone_frames(hand, posed.poses[row])[0][bone]
            spin = (bone_frames(hand, turned)[0][bone] @ before.T - np.eye(3)) / step
            axis = [spin[2, 1], spin[0, 2], spin[1, 0]]
            np.testing.assert_allclose(download(posed.axes)[row, angle], axis, atol=1e-5)


def test_any_angle_and_any_rotation_stays_a_rotation(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=3)
    nrow = 32
    poses = np.zeros((nrow, 28))
    poses[:, 3:7] = matrix_to_quat(rotvec_to_matrix(3 * rng.standard_normal((nrow, 3))))
    poses[:, 7:] = rng.uniform(-7, 7, (nrow, NANGLE))
    poses = rounded(poses)
    model = posed.model
    rotations = poisoned((nrow, NBONE), device, wp.mat33)
    origins = poisoned((nrow, NBONE), device, wp.vec3)
    axes = poisoned((nrow, NANGLE), device, wp.vec3)
    pose_bones(
        model.bone_rotations, model.bone_origins, model.bone_parents, model.bone_angles,
        model.angle_axes, upload(np.zeros(nrow, int), device), upload(poses, device),
        rotations=rotations, origins=origins, axes=axes,
    )  # fmt: skip
    r = download(rotations)
    identity = np.broadcast_to(np.eye(3), r.shape)
    np.testing.assert_allclose(r @ np.swapaxes(r, 2, 3), identity, atol=5e-6)
    np.testing.assert_allclose(np.linalg.norm(download(axes), axis=-1), 1.0, atol=5e-6)
    np.testing.assert_allclose(
        r, np.stack([bone_frames(posed.hands[0], pose)[0] for pose in poses]), atol=1e-5
    )


def test_rows_that_are_left_out_are_not_written(make_posed, device) -> None:
    posed = make_posed(device, seed=3)
    model, rows = posed.model, np.array([1, -1, 1])
    rotations = poisoned((3, NBONE), device, wp.mat33)
    origins = poisoned((3, NBONE), device, wp.vec3)
    axes = poisoned((3, NANGLE), device, wp.vec3)
    pose_bones(
        model.bone_rotations, model.bone_origins, model.bone_parents, model.bone_angles,
        model.angle_axes, upload(rows, device), posed.pose, rotations=rotations, origins=origins,
        axes=axes,
    )  # fmt: skip
    for array in (rotations, origins, axes):
        written = np.isfinite(download(array).reshape(3, -1))
        np.testing.assert_array_equal(written.all(1), [True, False, True])
        assert not written[1].any()
