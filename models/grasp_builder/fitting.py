"""A natural hand posture whose pads hold an object: damped least squares on all of one pose.

Pads go to the surface and face it, fingers oppose the thumb, skin stays out of the object and the
table, and joints stay near to a posture that people have in the grip mode, fingers alike and end
joints coupled to middle joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from grasp_builder.placing import Placing
from handtrack.grasp.taxonomy import DIP_SHARE, GripMode, GripPads
from handtrack.hand.inverse_kinematics import BonePoints, point_jacobian
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, DISTAL_BONES, FINGERS, NV
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import apply_increment, matrix_to_quat, pose_difference

Float = NDArray[np.float64]

PRESS = 0.0003
"""How deep pads press into the surface [m]."""

CLEARANCE, TABLE_CLEARANCE = 0.0004, 0.003
"""How far other skin stays away from the object and from the table [m]."""

YIELD, PAD_SIZE = 0.0006, 0.008
"""How deep skin near a pad may be [m], and how near that is [m]: flesh gives way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerances:
    """Standard deviations of what is asked for: the smaller, the more it counts."""

    distance: float = 0.0004
    """Pads from the surface [m]."""
    facing: float = 0.25
    """Skin normals from the surface's, as the sine of the angle."""
    opposing: float = 0.003
    """Thumb from the line of force of the fingers' middle [m]."""
    place: float = 0.006
    """Middle of thumb and fingers from where they are to press [m]."""
    palm_pad: float = 0.004
    """Palm from the surface [m], where it takes part."""
    flexion: float = np.deg2rad(20.0)
    """Flexion from the grip's typical posture [rad]."""
    resting: float = np.deg2rad(8.0)
    """Angles of fingers that do not close, from their typical posture [rad]."""
    abduction: float = np.deg2rad(7.0)
    """Abduction from the typical posture [rad]."""
    alike: float = np.deg2rad(7.0)
    """Flexion of neighbouring fingers, beyond the difference they have typically [rad]."""
    coupling: float = np.deg2rad(3.0)
    """End joint from its share of the middle joint [rad]."""
    palm_turn: float = np.deg2rad(15.0)
    """Palm from the orientation that it comes in [rad]."""
    overlap: float = 0.0004
    """Skin inside the object or the table [m]."""


class GraspFit:
    """Fits one hand in one grip mode to one object."""

    def __init__(
        self, hand: ShapedHand, mode: GripMode, pads: GripPads, distances: DistanceField,
        floor: float, *, tolerances: Tolerances | None = None,
    ) -> None:  # fmt: skip
        """Prepare.

        Args:
            hand: The hand.
            mode: The grip mode.
            pads: Its pads.
            distances: Signed distances of the object.
            floor: Height of the table below the object's centre of mass [m], negative.
            tolerances: What counts how much.
        """
        self.hand, self.mode, self.pads = hand, mode, pads
        self.tolerances = tolerances or Tolerances()
        self._field, self._floor = distances, floor
        self._contacts = BonePoints(bones=pads.bones, offsets=pads.points)
        self._ahead = BonePoints(bones=pads.bones, offsets=pads.points + pads.normals)
        self._skin = np.union1d(_spread(hand, 500), _fingertips(hand))
        self._moved = BonePoints.of_skin(hand, self._skin)
        self._fingers = np.array(
            [k for k, pad in enumerate(mode.pads) if k > 0 and pad.bone != "palm"]
        )
        self._posture_rows = _posture_rows(mode, self.tolerances)

    def start(self, placing: Placing) -> Float:
        """The typical posture around the object, opened as wide as the object is, shape (28,)."""
        width = self.width(placing)
        closed, opening = np.array(self.mode.closed), np.array(self.mode.opening)
        best, best_gap = closed, np.inf
        for share in np.linspace(-1.5, 3.0, 46):
            angles = (closed + share * opening).clip(*self.hand.limits.T)
            gap = abs(np.linalg.norm(self._ends(angles)[1]) - width)
            if gap < best_gap:
                best, best_gap = angles, gap
        middle, press = self._ends(best)
        local = _frame(press, middle)
        world = _frame(placing.press, placing.approach)
        turn = world @ local.T
        pose = np.zeros(28)
        pose[3:7] = matrix_to_quat(turn)
        pose[7:] = best
        pose[:3] = placing.middle - turn @ middle
        return pose

    def width(self, placing: Placing) -> float:
        """Width of the object along the pressing direction [m]."""
        reach = np.arange(0.0, 0.12, 0.0005)
        line = placing.middle + np.concatenate([reach, -reach])[:, None] * placing.press
        inside = self.distance(placing, line) < 0.0
        return float(inside.sum() * 0.0005)

    def places(self, pose: Float) -> Float:
        """Where the pads are [m], shape (npad, 3)."""
        return self._contacts.place(self.hand, pose)

    def local_distance(self, points: Float) -> Float:
        """Signed distances [m], shape (...), of points in the object's frame, shape (..., 3)."""
        return self._field.distance(points)

    def distance(self, placing: Placing, points: Float) -> Float:
        """Signed distances [m], shape (...), of points in the placing's frame, shape (..., 3)."""
        return self._field.distance(points @ placing.turn)

    def normal(self, placing: Placing, points: Float) -> Float:
        """Outward normals of the surface, shape (..., 3), near points, shape (..., 3)."""
        return self._field.normal(points @ placing.turn) @ placing.turn.T

    def fit(self, placing: Placing, start: Float, *, iterations: int = 60) -> Float:
        """The grasp, shape (28,), from a start pose, shape (28,)."""
        pose, damping = start, 1e-2
        system, residual = self._linearised(placing, pose, start)
        energy = float(residual @ residual)
        for _ in range(iterations):
            hessian = system.T @ system
            hessian[np.diag_indices(NV)] *= 1.0 + damping
            step = -np.linalg.solve(hessian, system.T @ residual)
            step /= max(1.0, np.abs(step[3:]).max() / 0.15, np.abs(step[:3]).max() / 0.01)
            tried = apply_increment(pose, step)
            tried[7:] = tried[7:].clip(*self.hand.limits.T)
            rows, values = self._linearised(placing, tried, start)
            if values @ values < energy:
                gain = energy - float(values @ values)
                pose, system, residual, energy = tried, rows, values, float(values @ values)
                damping = max(0.3 * damping, 1e-6)
                if gain < 1e-5 * energy:
                    break
            else:
                damping = min(6.0 * damping, 1e4)
        return pose

    def _ends(self, angles: Float) -> tuple[Float, Float]:
        """Middle between thumb and fingers, and the way from one to the other [m], palm frame."""
        pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])
        places = self._contacts.place(self.hand, pose)
        thumb, fingers = places[0], places[self._fingers].mean(0)
        return 0.5 * (thumb + fingers), fingers - thumb

    def _linearised(self, placing: Placing, pose: Float, start: Float) -> tuple[Float, Float]:
        """Rows (n, 27) and residuals (n,) in standard deviations."""
        t = self.tolerances
        rows, values = [], []

        def ask(deviation: float, row: Float, value: Float) -> None:
            rows.append(np.asarray(row).reshape(-1, NV) / deviation)
            values.append(np.ravel(value) / deviation)

        places, moves = (x[0] for x in point_jacobian(self.hand, self._contacts, pose[None]))
        ahead, ahead_moves = (x[0] for x in point_jacobian(self.hand, self._ahead, pose[None]))
        normals = self.normal(placing, places)
        away = self.distance(placing, places) + PRESS
        slopes = np.einsum("ci,cij->cj", normals, moves)
        tips = np.concatenate([[0], self._fingers])
        ask(t.distance, slopes[tips], away[tips])
        palms = np.setdiff1d(np.arange(len(away)), tips)
        ask(t.palm_pad, slopes[palms], away[palms])
        # Skin normals turn as fast as the way between two points a metre apart.
        ask(t.facing, (ahead_moves - moves)[tips], (ahead - places + normals)[tips])
        across = np.eye(3) - np.outer(placing.press, placing.press)
        fingers, fingers_move = places[self._fingers].mean(0), moves[self._fingers].mean(0)
        ask(t.opposing, across @ (fingers_move - moves[0]), across @ (fingers - places[0]))
        middle = 0.5 * (fingers + places[0]) - placing.middle
        ask(t.place, across @ (0.5 * (fingers_move + moves[0])), across @ middle)

        points = skin(self.hand, pose)[self._skin]
        _, skin_moves = (x[0] for x in point_jacobian(self.hand, self._moved, pose[None]))
        near = np.linalg.norm(points[:, None] - places[tips], axis=2).min(1) < PAD_SIZE
        depth = self.distance(placing, points) - np.where(near, -YIELD, CLEARANCE)
        inside = depth < 0.0
        out = self.normal(placing, points[inside])
        ask(t.overlap, np.einsum("ci,cij->cj", out, skin_moves[inside]), depth[inside])
        above = points[:, 2] - self._floor - TABLE_CLEARANCE
        below = above < 0.0
        ask(t.overlap, skin_moves[below, 2], above[below])

        matrix, typical = self._posture_rows
        ask(1.0, matrix, matrix[:, 6:] @ pose[7:] - typical)
        turned = np.zeros((3, NV))
        turned[:, 3:6] = np.eye(3)
        ask(t.palm_turn, turned, pose_difference(pose, start)[3:6])
        return np.concatenate(rows), np.concatenate(values)


def _frame(press: Float, approach: Float) -> Float:
    """Rotation whose columns are the pressing direction, the approach square to it, and a third."""
    x = press / np.linalg.norm(press)
    y = approach - (approach @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _spread(hand: ShapedHand, count: int) -> NDArray[np.intp]:
    """Vertices of fingers and palm far from each other, shape (count,)."""
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    vertices = skin(hand, pose)
    left = np.flatnonzero(~hand.stub_vertices)
    chosen = [int(left[0])]
    away = np.linalg.norm(vertices[left] - vertices[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(left[away.argmax()]))
        away = np.minimum(away, np.linalg.norm(vertices[left] - vertices[chosen[-1]], axis=1))
    return np.array(chosen)


def _fingertips(hand: ShapedHand) -> NDArray[np.intp]:
    """Vertices of the fingertips' palmar sides, where a coarse spread would miss what enters."""
    slot = hand.weights.argmax(1)
    rows = np.arange(hand.nvert)
    ends = np.isin(hand.weight_bones[rows, slot], DISTAL_BONES)
    return np.flatnonzero(ends & (hand.local_normals[rows, slot, 1] > -0.2))


def _posture_rows(mode: GripMode, t: Tolerances) -> tuple[Float, Float]:
    """What a natural posture asks of the angles: rows (n, 27), and what they should give, (n,)."""
    typical = np.array(mode.closed)
    rows, wanted = [], []

    def ask(deviation: float, parts: dict[str, float], value: float) -> None:
        row = np.zeros(NV)
        for name, factor in parts.items():
            row[6 + ANGLES.index(name)] = factor / deviation
        rows.append(row)
        wanted.append(value / deviation)

    for k, name in enumerate(ANGLES):
        finger, joint = name.split("_", 1)
        if finger not in mode.fingers:
            ask(t.resting, {name: 1.0}, typical[k])
        elif "abduction" in joint:
            ask(t.abduction * (2.0 if finger == "thumb" else 1.0), {name: 1.0}, typical[k])
        elif joint != "dip_flexion":
            ask(t.flexion, {name: 1.0}, typical[k])
    for finger in FINGERS[1:]:
        ask(t.coupling, {f"{finger}_dip_flexion": 1.0, f"{finger}_pip_flexion": -DIP_SHARE}, 0.0)
    closing = [finger for finger in mode.fingers if finger != "thumb"]
    for first, second in pairwise(closing):
        for joint in ("mcp_flexion", "pip_flexion"):
            names = (f"{first}_{joint}", f"{second}_{joint}")
            value = typical[ANGLES.index(names[0])] - typical[ANGLES.index(names[1])]
            ask(t.alike, {names[0]: 1.0, names[1]: -1.0}, value)
    return np.array(rows), np.array(wanted)
