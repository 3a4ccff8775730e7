"""What a hand cannot grasp, and why: told before a search where it can be, and after it."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.grasp.feasibility import feasible
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, NQ, TIP_KEYPOINTS
from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]

REACH = 1.0
"""Farthest a hand goes for an object, and carries it [m]: an arm's length and a bend."""

SUNK = 0.001
"""An object so deep in the table is not on it [m]."""

SOLID = 0.9
"""Share of its convex hull that a body fills at least to be held only from outside: no rim, no
handle."""

FACING = 0.65
"""Share of the wide open hand's span up to which the pads of thumb and fingers face each other."""

FAR = 0.005
"""A contact so far from the surface does not touch [m]."""


def check_task(
    hand: ShapedHand, body: RigidObject, *, place: Float, target: Float, start: Float | None
) -> None:
    """Check that a task is one that a hand could do.

    Args:
        hand: The hand.
        body: The object.
        place: Pose of the object in the world, whose table is z = 0, shape (7,).
        target: Pose it is to be brought to, shape (7,).
        start: The hand before, world, shape (28,); None: not known.

    Raises:
        InputError: It is not; the message says why.
    """
    for pose, where in ((place, "starts"), (target, "is to be brought")):
        heights = body.vertices @ quat_to_matrix(pose[3:])[2] + pose[2]
        if heights.min() < -SUNK:
            raise InputError(
                f"{body.name} {where} {-1000 * heights.min():.0f} mm inside the table: its pose "
                "there is that of its centre of mass, the table is z = 0"
            )
    way = float(np.linalg.norm(target[:3] - place[:3]))
    if way > REACH:
        raise InputError(
            f"the target is {way:.2f} m from {body.name}: out of reach, a hand carries {REACH:g} m "
            "at most"
        )
    if start is not None:
        away = float(np.linalg.norm(palm_centre(keypoints(hand, start)) - place[:3]))
        if away > REACH:
            raise InputError(
                f"{body.name} is {away:.2f} m from the hand: out of reach, which is {REACH:g} m"
            )
    opening = widest_grasp(hand)
    if body.extents.min() > opening and _is_solid(body):
        width = narrowest(body.vertices)
        if width > opening:
            raise InputError(
                f"{body.name} is too big: {1000 * width:.0f} mm where it is narrowest, and the "
                f"hand grasps {1000 * opening:.0f} mm at most"
            )


def narrowest(vertices: Float) -> float:
    """Least width of a body between two parallel planes [m], from its vertices, shape (n, 3)."""
    hull = trimesh.Trimesh(vertices, process=False).convex_hull
    # A least width lies across a face, or between two edges, to which some direction is near.
    directions = np.concatenate([hull.face_normals, _sphere_directions(400)])
    along = hull.vertices @ directions.T
    return float((along.max(0) - along.min(0)).min())


def widest_grasp(hand: ShapedHand) -> float:
    """Width of the widest body that thumb and fingers can press on from both sides [m]."""
    pose = np.zeros(NQ)
    pose[3] = 1.0
    low, high = hand.limits.T
    flexed = np.array([name.endswith("flexion") for name in ANGLES])
    open_hand = np.where(flexed, np.maximum(low, 0.0), 0.0)
    tips = []
    # Which sign of the thumb's joint angles leads away from the fingers differs by joint.
    for flexion in (low[0], high[0]):
        for abduction in (low[1], high[1]):
            pose[7:] = open_hand
            pose[7:9] = flexion, abduction
            tips.append(keypoints(hand, pose)[list(TIP_KEYPOINTS)])
    return FACING * float(max(np.linalg.norm(tip[1:] - tip[0], axis=1).max() for tip in tips))


def _is_solid(body: RigidObject) -> bool:
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    return bool(mesh.volume > SOLID * mesh.convex_hull.volume)


def reason_against(
    body: RigidObject, points: Float, normals: Float, gaps: Float, *, friction: float,
    gravity: Float, load: float = 1.0,
) -> str:  # fmt: skip
    """Why contacts cannot carry an object.

    Args:
        body: The object.
        points: Contacts on its surface [m], its frame, shape (ncontact, 3).
        normals: Outward normals there, shape (ncontact, 3).
        gaps: How far the hand's pads are from them [m], shape (ncontact,).
        friction: Friction that is planned with.
        gravity: Acceleration of gravity in the object's frame [m/s^2], shape (3,).
        load: What they must carry, in weights of the object.
    """
    farthest = float(np.abs(gaps).max(initial=0.0))
    if farthest > FAR:
        return (
            f"no grasp of {body.name} was found: in the best one a finger stays "
            f"{1000 * farthest:.0f} mm from it; it is too big or of a shape unlike the database's"
        )
    most = most_carried(points, normals, friction=friction, gravity=gravity) / load
    if most > 0.0:
        return (
            f"{body.name} is too heavy: it weighs {body.mass:.2f} kg, and the best grasp found "
            f"carries {most:.2f} kg"
        )
    return f"no grasp of {body.name} was found whose fingers press against each other"


def most_carried(points: Float, normals: Float, *, friction: float, gravity: Float) -> float:
    """Largest mass that contacts can carry [kg], 0 where they hold nothing."""
    light, heavy = 0.0, 0.001
    while heavy < 1e3 and _carries(points, normals, friction, heavy, gravity):
        light, heavy = heavy, 2.0 * heavy
    if light == 0.0:
        return 0.0
    for _ in range(8):
        middle = 0.5 * (light + heavy)
        carries = _carries(points, normals, friction, middle, gravity)
        light, heavy = (middle, heavy) if carries else (light, middle)
    return light


def _carries(points: Float, normals: Float, friction: float, mass: float, gravity: Float) -> bool:
    return feasible(points, normals, friction=friction, mass=mass, gravity=gravity).feasible


def _sphere_directions(count: int) -> Float:
    """Unit vectors spread evenly over half a sphere (Fibonacci spiral), shape (count, 3)."""
    height = (np.arange(count) + 0.5) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
