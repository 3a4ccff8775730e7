"""Left hands: the world seen in a mirror, where they are right ones.

The mirror is the plane x = 0 of the world and of the object's own frame. What comes from recordings
of right hands is planned for the mirrored object, and the plan is mirrored back (hand/side.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.grasp.objective import Wish
from handtrack.grasp.plan import GraspPlan
from handtrack.hand.side import mirror_points, mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject

Float = NDArray[np.float64]

FLIP = np.array([-1.0, 1.0, 1.0])
"""Diagonal of the mirror matrix in the world and in an object's frame."""

FLIP_POSE = np.array([-1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
"""Signs of a mirrored object's centre and quaternion."""


def mirrored_object(body: RigidObject) -> RigidObject:
    """The object's mirror image; primitives are their own."""
    return replace(
        body, vertices=body.vertices * FLIP, faces=np.ascontiguousarray(body.faces[:, ::-1]),
        pieces=tuple(piece * FLIP for piece in body.pieces),
        unit_inertia=body.unit_inertia * np.outer(FLIP, FLIP),
    )  # fmt: skip


def mirrored_field(field: DistanceField) -> DistanceField:
    """Signed distances of the mirror image."""
    origin = field.origin.copy()
    origin[0] = -(origin[0] + (len(field.values) - 1) * field.spacing)
    return replace(field, values=np.ascontiguousarray(field.values[::-1]), origin=origin)


def mirrored_object_poses(poses: ArrayLike) -> Float:
    """Poses of the mirror image, shape (..., 7)."""
    return np.asarray(poses, np.float64) * FLIP_POSE


def mirrored_wish(wish: Wish) -> Wish:
    """What is asked for, of the other hand and the mirror image."""
    points, pose = wish.contact_points, wish.hand_pose
    return Wish(
        contact_points=None if points is None else np.asarray(points, np.float64) * FLIP,
        hand_pose=None if pose is None else mirror_pose(pose),
    )


def mirrored_plan(plan: GraspPlan) -> GraspPlan:
    """The plan of the other hand for the mirror image."""
    return replace(
        plan, hand_poses=mirror_pose(plan.hand_poses),
        object_poses=mirrored_object_poses(plan.object_poses),
        contact_local=mirror_points(plan.contact_local),
        contact_points=plan.contact_points * FLIP, contact_normals=plan.contact_normals * FLIP,
    )  # fmt: skip
