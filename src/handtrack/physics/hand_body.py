"""The hand as bodies, joints and collision shapes of a MuJoCo model.

Two layouts of the same skeleton: "tracking" has the 27 degrees of freedom of the pose vector, so
that MuJoCo's qpos is the pose; "ball" has the 33 of thesis Fig. III.2, with ball joints at the
knuckles and at the thumb's two lower joints.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import (
    ANGLE_BONES,
    ANGLES,
    BASE_BONES,
    BONE_PARENTS,
    BONES,
    NBONE,
    finger_of_bone,
)
from handtrack.optional import import_extra
from handtrack.physics.bone_solids import BoneSolid
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

Layout = Literal["tracking", "ball"]
LAYOUTS: tuple[Layout, ...] = ("tracking", "ball")

BALL_BONES: tuple[int, ...] = (1, 2, 4, 7, 10, 13)
"""Bones on ball joints in the layout "ball": the thumb's two lower ones and the four knuckles."""


LIMIT_RECOVERY = (0.005, 1.0)
"""Time constant [s] and damping ratio with which a joint comes back from beyond its limit."""


def check_layout(layout: str) -> Layout:
    """Return `layout` when it is one of `LAYOUTS`.

    Raises:
        InputError: It is not.
    """
    if layout not in LAYOUTS:
        raise InputError(f"layout is {layout!r}; expected one of {', '.join(LAYOUTS)}")
    return layout  # type: ignore[return-value]


def joints_of(bone: int, layout: Layout) -> tuple[str, ...]:
    """Names of a bone's joints in the order of qpos; the palm has its free joint."""
    if bone == 0:
        return ("palm",)
    if layout == "ball" and bone in BALL_BONES:
        return (BONES[bone],)
    return tuple(name for name, moved in zip(ANGLES, ANGLE_BONES, strict=True) if moved == bone)


def add_hand(
    spec: Any,
    hand: ShapedHand,
    solids: tuple[BoneSolid, ...],
    *,
    layout: Layout,
    friction: tuple[float, float, float],
    armature: float,
    contact: dict[str, Any],
) -> None:
    """Add the hand to a `mujoco.MjSpec`: bodies named as the bones, palm on a free joint.

    Args:
        spec: The model being built.
        hand: One person's hand.
        solids: Its `bone_solids`.
        layout: Joint layout.
        friction: Sliding [1], torsional [m] and rolling [m] friction of the skin.
        armature: Inertia added to every finger joint [kg m^2].
        contact: MuJoCo's settings of its contacts.
    """
    mujoco = import_extra("mujoco", "physics", "simulating the hand")
    bodies = [spec.worldbody]
    for bone in range(NBONE):
        parent = bodies[BONE_PARENTS[bone] + 1] if bone else spec.worldbody
        body = parent.add_body(name=BONES[bone])
        solid = solids[bone]
        body.explicitinertial = True
        body.mass, body.ipos = solid.mass, solid.centre
        # MuJoCo's order of a full inertia: xx, yy, zz, xy, xz, yz.
        body.fullinertia = solid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        if bone == 0:
            body.add_freejoint(name="palm")
        else:
            body.pos = hand.bone_origins[bone]
            body.quat = matrix_to_quat(hand.bone_rotations[bone])
            _add_joints(mujoco, body, hand, bone, layout, armature)
        for k, corners in enumerate(solid.pieces):
            name = f"{BONES[bone]}_{k}" if len(solid.pieces) > 1 else BONES[bone]
            spec.add_mesh(name=name, uservert=corners.ravel())
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, friction=friction,
                rgba=(0.87, 0.66, 0.53, 1.0), **contact,
            )  # fmt: skip
        bodies.append(body)
    for first, second in _never_touching():
        spec.add_exclude(bodyname1=BONES[first], bodyname2=BONES[second])


def _add_joints(
    mujoco: Any, body: Any, hand: ShapedHand, bone: int, layout: Layout, armature: float
) -> None:
    angles = [angle for angle, moved in enumerate(ANGLE_BONES) if moved == bone]
    if layout == "ball" and bone in BALL_BONES:
        # A ball joint has one limit, the angle from straight: the widest that its axes allow.
        body.add_joint(
            name=BONES[bone], type=mujoco.mjtJoint.mjJNT_BALL, armature=armature,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, solref_limit=LIMIT_RECOVERY,
            range=(0.0, float(np.linalg.norm(np.abs(hand.limits[angles]).max(1)))),
        )  # fmt: skip
        return
    for angle in angles:
        body.add_joint(
            name=ANGLES[angle], type=mujoco.mjtJoint.mjJNT_HINGE, armature=armature,
            axis=hand.angle_axes[angle], range=hand.limits[angle],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, solref_limit=LIMIT_RECOVERY,
        )  # fmt: skip


def _never_touching() -> list[tuple[int, int]]:
    """Pairs of bones whose solids may overlap: near in the skeleton, or side by side.

    What is left to collide: the thumb's and the fingers' two outer bones with each other and with
    the palm.
    """
    pairs = []
    for first in range(NBONE):
        for second in range(first + 1, NBONE):
            same = finger_of_bone(first) == finger_of_bone(second)
            inner = _is_inner(first) or _is_inner(second)
            beside = (
                abs(finger_of_bone(first) - finger_of_bone(second)) == 1
                and min(finger_of_bone(first), finger_of_bone(second)) > 0
            )
            palm = first == 0 and _is_inner(second)
            if same or palm or (inner and (first != 0)) or beside:
                pairs.append((first, second))
    return pairs


def _is_inner(bone: int) -> bool:
    """Whether a bone is the palm or the first of its finger."""
    return bone == 0 or bone in BASE_BONES
