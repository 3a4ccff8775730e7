"""Grasps made by hand: pads laid on a box or a ball by inverse kinematics, for tests of physics."""

from __future__ import annotations

import numpy as np

from handtrack.grasp.plan import GraspPlan
from handtrack.hand.inverse_kinematics import BonePoints, solve_poses
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES
from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

TRIPOD = (3, 6, 9)
"""Outer bones of thumb, index and middle finger."""

FRAME_RATE = 60.0
FLESH = 0.008
"""How deep under a pad the point lies that turns the pad to the surface [m]."""


def pad(hand: ShapedHand, bone: int) -> np.ndarray:
    """Middle of the pad of an outer bone [m], its frame, shape (3,)."""
    skin = hand.local_vertices[(hand.weight_bones == bone) & (hand.weights >= 0.5)]
    place = 0.55 * hand.bone_lengths[bone]
    near = skin[np.abs(skin[:, 0] - place) < 0.3 * hand.bone_lengths[bone]]
    middle = 0.5 * (near[:, 2].min() + near[:, 2].max())
    ridge = near[np.abs(near[:, 2] - middle) < 0.004]
    return np.array([place, ridge[:, 1].max(), middle])


def places(thing: RigidObject, bones: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Where the pads go [m] and the outward normals there, object frame: thumb at -x."""
    assert thing.primitive is not None
    radius = thing.primitive.size[0]
    fingers = len(bones) - 1
    aside = 0.021 * (np.arange(fingers) - 0.5 * (fingers - 1))[::-1]
    normals = np.zeros((len(bones), 3))
    normals[0] = [-1.0, 0.0, 0.0]
    if thing.primitive.kind == "box":
        normals[1:] = [1.0, 0.0, 0.0]
        points = radius * normals
        points[1:, 1] = aside
    else:
        angles = aside / (radius + 0.008)
        normals[1:] = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], -1)
        points = radius * normals
    return points, normals


def grasping_pose(
    hand: ShapedHand, thing: RigidObject, bones: tuple[int, ...], *, starts: int = 60
) -> np.ndarray:
    """Hand pose in the object's frame with the pads on it, the best of several starts, (28,)."""
    rng = np.random.default_rng(5)
    points, normals = places(thing, bones)
    local = np.array([pad(hand, bone) for bone in bones])
    marks = BonePoints(
        bones=np.array([*bones, *bones]), offsets=np.concatenate([local, local - [0, FLESH, 0]])
    )
    goals = np.concatenate([points, points + FLESH * normals])
    pose = np.zeros((starts, 28))
    for row in pose:
        pitch, yaw = rng.uniform(0.1, 1.3), rng.uniform(-0.9, 1.2)
        c, s = np.cos(pitch), np.sin(pitch)
        turn = rotvec_to_matrix([0, 0, yaw]) @ np.stack([[c, 0, -s], [-s, 0, -c], [0, 1, 0]], 1)
        row[3:7], row[:3] = matrix_to_quat(turn), -turn @ [0.13, 0.04, 0.0]
        row[7:] = hand.rest_angles
        row[12:] += np.tile([0.4, 0.0, 0.4, 0.2], 4)
    found = solve_poses(hand, marks, np.tile(goals, (starts, 1, 1)), pose, rest_weight=1e-5)
    miss = np.linalg.norm(marks.place(hand, found) - goals, axis=-1).max(1)
    strain = np.abs(found[:, 7:] - hand.rest_angles).mean(1)
    return found[np.argmin(miss + 0.003 * strain)]


def handmade_plan(
    hand: ShapedHand,
    thing: RigidObject,
    *,
    bones: tuple[int, ...] = TRIPOD,
    carry: tuple[float, float, float] = (0.0, 0.2, 0.12),
    carry_time: float = 1.0,
    set_down: bool = False,
) -> GraspPlan:
    """Reach down, close, carry through the air.

    Args:
        hand: The hand.
        thing: A box or ball, at rest at the origin.
        bones: Outer bones of the thumb first, then of fingers side by side.
        carry: Way of the object [m].
        carry_time: How long it takes [s].
        set_down: Whether the way is an arch, at whose end the hand lets go.
    """
    points, normals = places(thing, bones)
    closed = grasping_pose(hand, thing, bones)
    closed[2] += thing.rest_height
    opened = closed.copy()
    ways = {"thumb_tm_flexion": 0.3, "thumb_mcp_flexion": 0.2, "thumb_ip_flexion": 0.1}
    for angle, name in enumerate(ANGLES):
        if name.endswith("flexion"):
            opened[7 + angle] -= ways.get(name, 0.175 if "dip" in name else 0.35)
    opened[7:] = np.clip(opened[7:], *hand.limits.T)
    away = opened.copy()
    away[:3] += (-0.05, 0.0, 0.06)
    start = np.array([0.0, 0.0, thing.rest_height, 1.0, 0.0, 0.0, 0.0])
    hands, things, phases = [], [], []
    legs = [
        (away, opened, 18, "reaching"), (opened, closed, 18, "closing"),
        (closed, closed, round(carry_time * FRAME_RATE), "manipulation"),
    ]  # fmt: skip
    if set_down:
        legs.append((closed, opened, 24, "releasing"))
    for begin, end, count, phase in legs:
        share = np.arange(count) / (count - 1)
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        path = begin + (end - begin) * share[:, None]
        thing_path = np.tile(start, (count, 1))
        if phase in ("manipulation", "releasing"):
            moved = share if phase == "manipulation" else np.ones(count)
            way = moved[:, None] * np.array(carry)
            if set_down:
                way[:, 2] += 0.12 * np.sin(np.pi * moved)
            path[:, :3] += way
            thing_path[:, :3] += way
        hands.append(path)
        things.append(thing_path)
        phases += [phase] * count
    return GraspPlan(
        grip="tripod", times=np.arange(len(phases)) / FRAME_RATE, hand_poses=np.concatenate(hands),
        object_poses=np.concatenate(things), phases=np.array(phases),
        contact_bones=np.array(bones), contact_local=np.array([pad(hand, b) for b in bones]),
        contact_points=points, contact_normals=normals, feasible=True,
    )  # fmt: skip
