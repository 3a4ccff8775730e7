"""The parametric hand by its equations (thesis II.1 to II.9), one vertex, one matrix at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape

Float = NDArray[np.float64]

PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
# Angles of each bone, outermost first: thumb 2, 2, 1; fingers 2, 1, 1 (II.3.1).
BONE_ANGLES = [
    [],
    [0, 1], [2, 3], [4],
    [5, 6], [7], [8],
    [9, 10], [11], [12],
    [13, 14], [15], [16],
    [17, 18], [19], [20],
]  # fmt: skip
BASES = [1, 4, 7, 10, 13]
TIPS = [3, 6, 9, 12, 15]


def turn(axis: Float, angle: float) -> Float:
    """Rotation matrix as the exponential of a skew-symmetric matrix."""
    x, y, z = axis * angle
    return expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))


def chain(
    rotations: Float, origins: Float, axes: Float, angles: Float, root: Float | None = None
) -> list[Float]:
    """T_j of Eq. II.8: 4x4 frames of the 16 bones, `root` being the palm's."""
    frames: list[Float] = []
    for bone, parent in enumerate(PARENTS):
        if parent < 0:
            frames.append(np.eye(4) if root is None else root)
            continue
        local = np.eye(4)
        local[:3, :3] = rotations[bone]
        for angle in BONE_ANGLES[bone]:
            local[:3, :3] = local[:3, :3] @ turn(axes[angle], angles[angle])
        local[:3, 3] = origins[bone]
        frames.append(frames[parent] @ local)
    return frames


def palm_frame(pose: Float) -> Float:
    """4x4 frame of the palm: translation and unit quaternion w x y z."""
    w, *v = pose[3:7]
    x, y, z = v
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    frame = np.eye(4)
    frame[:3, :3] = np.eye(3) + 2 * w * skew + 2 * skew @ skew
    frame[:3, 3] = pose[:3]
    return frame


class Subject:
    """One person: the skeleton and the local vertices of Eq. II.1 to II.7."""

    def __init__(self, model: HandModel, shape: HandShape) -> None:
        alpha = np.zeros(model.nalpha)
        alpha[: len(shape.alpha)] = shape.alpha
        beta = np.zeros(model.nbeta)
        beta[: len(shape.beta)] = shape.beta
        scales = model.scale_mean + model.scale_basis @ alpha  # II.4
        scales[0] *= shape.scale
        offsets = model.offset_mean + model.offset_basis @ beta  # II.6
        self.model = model
        self.scales = scales
        self.rest = chain(
            model.bone_rotations, model.bone_origins, model.dof_axes, model.rest_angles
        )
        self.offsets = offsets
        self.origins = np.zeros((16, 3))
        for bone, parent in enumerate(PARENTS):
            if parent < 0:
                continue
            origin = model.bone_origins[bone].copy()
            if bone in BASES:
                origin += offsets[len(model.vertices) + BASES.index(bone)]
            self.origins[bone] = self.stretch(parent, origin)
        self.tips = np.array(
            [self.stretch(bone, tip) for bone, tip in zip(TIPS, model.tip_offsets, strict=True)]
        )

    def stretch(self, bone: int, point: Float) -> Float:
        """S (x) v of Eq. II.3: s_g (s_j v_x, v_y, v_z)."""
        return self.scales[0] * point * np.array([self.scales[1 + bone], 1.0, 1.0])

    def frames(self, pose: Float) -> list[Float]:
        """T_j(q) of the person's skeleton, camera frame."""
        return chain(
            self.model.bone_rotations, self.origins, self.model.dof_axes, pose[7:],
            palm_frame(pose),
        )  # fmt: skip

    def vertex(self, index: int, frames: list[Float]) -> Float:
        """One posed vertex (II.9): sum of w_ij T_j(q) (S (x) v_ij)."""
        model = self.model
        total = np.zeros(3)
        for bone, weight in zip(model.weight_bones[index], model.weights[index], strict=True):
            rest = self.rest[bone]
            local = rest[:3, :3].T @ (model.vertices[index] - rest[:3, 3])  # II.1
            local = local + rest[:3, :3].T @ self.offsets[index]  # II.5
            local = self.stretch(bone, local)  # II.7
            total += weight * (frames[bone] @ np.append(local, 1.0))[:3]
        return total

    def keypoints(self, pose: Float) -> Float:
        """The 21 keypoints: wrist, then per finger the three joints and the tip."""
        frames = self.frames(pose)
        points = [frames[0][:3, 3]]
        for finger, base in enumerate(BASES):
            points += [frames[bone][:3, 3] for bone in range(base, base + 3)]
            points.append((frames[base + 2] @ np.append(self.tips[finger], 1.0))[:3])
        return np.array(points)
