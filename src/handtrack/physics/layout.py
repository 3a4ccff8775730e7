"""The hand's coordinates in a MuJoCo model: poses to and from qpos of either layout."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLE_BONES, NANGLE, NBONE
from handtrack.physics.hand_body import BALL_BONES, Layout
from handtrack.transforms import matrix_to_quat, quat_to_matrix, rotvec_to_matrix

Float = NDArray[np.float64]


class HandLayout:
    """Sizes and conversions of one hand in one layout."""

    def __init__(self, hand: ShapedHand, layout: Layout) -> None:
        """Note where each bone's numbers stand.

        Args:
            hand: One person's hand.
            layout: Joint layout.
        """
        self.layout = layout
        self._axes = hand.angle_axes
        balls = set(BALL_BONES) if layout == "ball" else set()
        self._angles = [np.flatnonzero(np.asarray(ANGLE_BONES) == bone) for bone in range(NBONE)]
        self._balls = [bone in balls for bone in range(NBONE)]
        self.nq = 7 + sum(n for _, n, _ in self._entries())
        self.nv = 6 + sum(3 if ball else n for _, n, ball in self._entries())

    def _entries(self) -> Iterator[tuple[int, int, bool]]:
        """Bone, numbers in qpos and whether it is a ball joint, of every moving bone."""
        for bone in range(1, NBONE):
            ball = self._balls[bone]
            yield bone, 4 if ball else len(self._angles[bone]), ball

    def bone_dofs(self) -> NDArray[np.int64]:
        """Bone that each degree of freedom moves, the palm's six first, shape (nv,)."""
        bones = [0] * 6
        for bone, size, ball in self._entries():
            bones += [bone] * (3 if ball else size)
        return np.array(bones)

    def qpos(self, pose: ArrayLike) -> Float:
        """qpos, shape (..., nq), of poses, shape (..., 28)."""
        pose = np.asarray(pose, np.float64)
        if self.layout == "tracking":
            return pose.copy()
        parts = [pose[..., :7]]
        for bone, _, ball in self._entries():
            angles = pose[..., 7 + self._angles[bone]]
            if ball:
                turns = rotvec_to_matrix(angles[..., None] * self._axes[self._angles[bone]])
                angles = matrix_to_quat(turns[..., 0, :, :] @ turns[..., 1, :, :])
            parts.append(angles)
        return np.concatenate(parts, axis=-1)

    def velocity(self, pose: ArrayLike, rates: ArrayLike) -> Float:
        """Velocities of the degrees of freedom, shape (..., nv).

        Args:
            pose: Poses, shape (..., 28).
            rates: Increments per second, shape (..., 27).
        """
        pose, rates = np.asarray(pose, np.float64), np.asarray(rates, np.float64)
        if self.layout == "tracking":
            return rates.copy()
        parts = [rates[..., :6]]
        for bone, _, ball in self._entries():
            own = self._angles[bone]
            rate = rates[..., 6 + own]
            if ball:
                first, second = self._axes[own]
                inner = rotvec_to_matrix(-pose[..., 7 + own[1], None] * second)
                rate = rate[..., :1] * (inner @ first) + rate[..., 1:] * second
            parts.append(rate)
        return np.concatenate(parts, axis=-1)

    def pose(self, qpos: ArrayLike) -> Float:
        """Pose, shape (28,), of qpos, shape (nq,); a ball joint's twist has no place in it."""
        qpos = np.asarray(qpos, np.float64)
        if self.layout == "tracking":
            return qpos.copy()
        pose = np.zeros(7 + NANGLE)
        pose[:7], at = qpos[:7], 7
        for bone, size, ball in self._entries():
            values = qpos[at : at + size]
            at += size
            if ball:
                first, second = self._axes[self._angles[bone]]
                basis = np.stack([first, second, np.cross(first, second)], -1)
                turn = Rotation.from_matrix(basis.T @ quat_to_matrix(values) @ basis)
                values = turn.as_euler("XYZ")[:2]
            pose[7 + self._angles[bone]] = values
        return pose
