"""Hands on a device in some poses, with the frames and vertices that other kernels read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.kinematics import bone_frames, skin, skin_normals
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NANGLE, NBONE
from handtrack.kernels.kinematics import pose_bones
from handtrack.kernels.skinning import skin_vertices
from oracles.device_arrays import poisoned, upload
from oracles.scenes import rounded, seen_poses, shaped_hand

ROW_HAND = (1, 0, 1)
"""Hand of each row: rows and hands differ in number and order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Posed:
    """Rows of posed hands: host truth in float64 and the kernels' inputs on the device."""

    hands: tuple[ShapedHand, ...]
    row_hand: tuple[int, ...]
    poses: NDArray[np.float64]
    model: DeviceHand
    rows: wp.array
    pose: wp.array
    rotations: wp.array
    origins: wp.array
    axes: wp.array
    vertices: wp.array
    normals: wp.array

    @property
    def nrow(self) -> int:
        return len(self.row_hand)

    @property
    def nvert(self) -> int:
        return self.hands[0].nvert

    def hand(self, row: int) -> ShapedHand:
        """Hand of a row."""
        return self.hands[self.row_hand[row]]

    def palm(self, row: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation and origin of a row's palm."""
        rotations, origins = bone_frames(self.hand(row), self.poses[row])
        return rotations[0], origins[0]

    def skin(self, row: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vertices and normals of a row."""
        hand, pose = self.hand(row), self.poses[row]
        return skin(hand, pose), skin_normals(hand, pose)


@pytest.fixture(scope="session")
def make_posed() -> Callable[..., Posed]:
    """Make posed rows: `make_posed(device, side=..., seed=..., **options of seen_poses)`."""

    def make(
        device: str,
        *,
        side: str = "right",
        seed: int = 0,
        row_hand: tuple[int, ...] = ROW_HAND,
        **options: float,
    ) -> Posed:
        rng = np.random.default_rng(seed)
        hands = tuple(shaped_hand(side, person) for person in range(max(row_hand) + 1))
        poses = np.concatenate([seen_poses(hands[h], rng, 1, **options) for h in row_hand])
        poses = rounded(poses)
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        model = DeviceHand.upload(hands, wp.get_device(device))
        nrow, nvert = len(row_hand), hands[0].nvert
        rows, pose = upload(np.array(row_hand), device), upload(poses, device)
        rotations = poisoned((nrow, NBONE), device, wp.mat33)
        origins = poisoned((nrow, NBONE), device, wp.vec3)
        axes = poisoned((nrow, NANGLE), device, wp.vec3)
        vertices = poisoned((nrow, nvert), device, wp.vec3)
        normals = poisoned((nrow, nvert), device, wp.vec3)
        pose_bones(
            model.bone_rotations, model.bone_origins, model.bone_parents, model.bone_angles,
            model.angle_axes, rows, pose, rotations=rotations, origins=origins, axes=axes,
        )  # fmt: skip
        skin_vertices(
            model.weight_bones, model.weights, model.local_vertices, model.local_normals, rows,
            rotations, origins, vertices=vertices, normals=normals,
        )  # fmt: skip
        return Posed(
            hands=hands, row_hand=row_hand, poses=poses, model=model, rows=rows, pose=pose,
            rotations=rotations, origins=origins, axes=axes, vertices=vertices, normals=normals,
        )  # fmt: skip

    return make
