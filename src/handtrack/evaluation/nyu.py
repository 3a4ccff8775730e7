"""NYU's annotated joints on our skeleton: a fixed map, and inverse kinematics from labelled joints.

NYU marks 36 points of the hand model its labels were made with (Tompson et al. 2014); 14 of them
are measured (`handtrack.evaluation.protocols.NYU`). They are not joints of our skeleton, so
`nyu_joints.json` says where each lies on it: the bone it is fixed to, and its place in that bone's
frame as fractions of lengths of the hand, which makes the map the same for every shape. The
numbers were estimated from the annotations alone by `models/nyu_map.py`, without the frames of the
sample images.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.evaluation.protocols import NYU
from handtrack.hand.inverse_kinematics import BonePoints, solve_poses
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import mirror_points
from handtrack.hand.skeleton import BONES
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

NYU_COUNT = 36
"""Number of points NYU annotates."""

PROTOCOL_JOINTS = np.array(NYU.source_joints)
"""Indices of the 14 measured joints among the 36, in the protocol's order."""

TABLE = "nyu_joints.json"
"""File beside this module with the map and its provenance."""

_SCALES = np.geomspace(0.6, 1.7, 12)
_SCALE_DEVIATION = 0.15
_RESIDUAL_DEVIATION_M = 0.005
"""Tried overall scales; adult hands differ by so much (logarithm), joints and map by so much."""

_FLEXIONS = (None, 0.2, 0.8)
"""Start poses tried: rest angles, then all fingers flexed by this share of their range."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointMap:
    """Where points of a data set lie on our skeleton, right hand."""

    bones: NDArray[np.int64]
    """Bone that each point is fixed to, shape (npoint,)."""
    fractions: Float
    """Place in the bone's frame, shape (npoint, 3): x as a fraction of the bone's length, y and z
    (palmar, radial) as fractions of the palm's length; the palm's length is that from the wrist to
    the middle finger's MCP joint."""

    def select(self, joints: ArrayLike) -> JointMap:
        """Part of the map: points by their index."""
        joints = np.asarray(joints, np.intp)
        return JointMap(bones=self.bones[joints], fractions=self.fractions[joints])

    def points(self, hand: ShapedHand) -> BonePoints:
        """The points on one person's hand, of either side, offsets in metres."""
        offsets = self.fractions * bone_units(hand)[self.bones]
        if hand.side == "left":
            offsets = mirror_points(offsets)
        return BonePoints(bones=self.bones, offsets=offsets)


def bone_units(hand: ShapedHand) -> Float:
    """Lengths [m] that a map's fractions multiply, shape (16, 3)."""
    units = np.full((len(BONES), 3), hand.bone_lengths[0])
    units[:, 0] = hand.bone_lengths
    return units


@cache
def nyu_map() -> JointMap:
    """The map of all 36 points."""
    rows = _table()["joints"]
    return JointMap(
        bones=np.array([BONES.index(row["bone"]) for row in rows]),
        fractions=np.array([row["fractions"] for row in rows], np.float64),
    )


def nyu_joints(hand: ShapedHand, pose: ArrayLike) -> Float:
    """The 14 joints of the NYU protocol.

    Args:
        hand: One person's hand.
        pose: Poses, shape (..., 28).

    Returns:
        Joints [m], shape (..., 14, 3), camera frame, in the protocol's order.
    """
    return nyu_map().select(PROTOCOL_JOINTS).points(hand).place(hand, pose)


def nyu_joints36(hand: ShapedHand, pose: ArrayLike) -> Float:
    """All 36 points NYU annotates [m], shape (..., 36, 3), of poses, shape (..., 28)."""
    return nyu_map().points(hand).place(hand, pose)


def start_pose_from_joints(
    model: HandModel, joints: ArrayLike, scale: float | None = None, *, side: str = "right"
) -> tuple[Float, float]:
    """Pose and overall scale of the mean hand whose NYU joints lie on labelled ones.

    Args:
        model: The hand model.
        joints: Labelled joints [m], camera frame, shape (36, 3), or (14, 3) in the protocol's
            order; NaN where a joint is not labelled.
        scale: Overall scale (`HandShape.scale`); estimated when None, with adult hands preferred.
        side: "right" or "left".

    Returns:
        Pose, shape (28,), and the overall scale.

    Raises:
        InputError: Joints of another shape, or fewer than six are labelled.
    """
    targets = np.asarray(joints, np.float64)
    if targets.shape not in ((NYU_COUNT, 3), (len(PROTOCOL_JOINTS), 3)):
        raise InputError(
            f"joints have shape {targets.shape}: expected NYU's (36, 3) or the protocol's (14, 3)"
        )
    known = np.isfinite(targets).all(axis=1)
    if known.sum() < 6:
        raise InputError(f"only {known.sum()} joints are labelled: at least 6 are needed")
    chosen = nyu_map() if len(targets) == NYU_COUNT else nyu_map().select(PROTOCOL_JOINTS)
    chosen, targets = chosen.select(np.flatnonzero(known)), targets[known]

    hand = model.shaped(HandShape(), side=side)
    scales = _SCALES if scale is None else np.array([HandShape(scale=scale).scale])
    pose, scale = _best(hand, chosen, targets, scales, iterations=40)
    if len(scales) > 1:
        step = scales[1] / scales[0]
        for _ in range(3):
            step = step**0.4
            near = scale * step ** np.arange(-2.0, 3.0)
            pose, scale = _best(hand, chosen, targets, near, start=pose, iterations=15)
    return pose, scale


def _best(
    hand: ShapedHand,
    chosen: JointMap,
    targets: Float,
    scales: Float,
    *,
    start: Float | None = None,
    iterations: int,
) -> tuple[Float, float]:
    """Pose and scale of least cost among some scales.

    Scaling the hand by s about the camera is the same as scaling the targets by 1/s, so one batch
    of the unscaled hand serves all scales.

    Args:
        hand: The hand at scale 1.
        chosen: The map of the labelled joints.
        targets: Labelled joints [m], shape (npoint, 3).
        scales: Scales to try, shape (n,).
        start: Pose at the middle one of the scales, shape (28,); found from the palm when None.
        iterations: Gauss-Newton steps.

    Returns:
        Pose, shape (28,), and scale.
    """
    points = chosen.points(hand)
    goals = targets / scales[:, None, None]
    if start is None:
        starts = [_laid_on(hand, points, goals, flexion) for flexion in _FLEXIONS]
        begin = np.concatenate(starts)
        goals = np.concatenate([goals] * len(starts))
        scales = np.concatenate([scales] * len(starts))
    else:
        begin = np.tile(start, (len(scales), 1))
        begin[:, :3] /= scales[:, None]
    poses = solve_poses(hand, points, goals, begin, iterations=iterations)
    residual = (points.place(hand, poses) - goals) * scales[:, None, None]
    cost = (residual**2).sum(axis=(1, 2)) / _RESIDUAL_DEVIATION_M**2
    cost += (np.log(scales) / _SCALE_DEVIATION) ** 2
    winner = int(np.argmin(cost))
    pose, scale = poses[winner].copy(), float(scales[winner])
    pose[:3] *= scale
    return pose, scale


def _laid_on(hand: ShapedHand, points: BonePoints, goals: Float, flexion: float | None) -> Float:
    """Poses with equal finger angles whose palm points, or all points, lie on the goals.

    Args:
        hand: The hand.
        points: Points on its bones.
        goals: Where they should be [m], shape (n, npoint, 3).
        flexion: Share of the way from the rest angles to the upper limits; None for the rest.

    Returns:
        Poses, shape (n, 28).
    """
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    if flexion is not None:
        bend = np.abs(hand.angle_axes[:, 2]) > 0.5
        pose[7:][bend] += flexion * (hand.limits[bend, 1] - hand.rest_angles[bend])
    source = points.place(hand, pose)
    palm = points.bones == 0
    used = palm if palm.sum() >= 3 else np.ones(len(palm), bool)
    a, b = source[used], goals[:, used]
    u, _, vt = np.linalg.svd(
        np.swapaxes(b - b.mean(axis=1, keepdims=True), 1, 2) @ (a - a.mean(axis=0))
    )
    # Kabsch: no reflection.
    sign = np.ones((len(goals), 1, 3))
    sign[:, 0, 2] = np.linalg.det(u @ vt)
    rotation = (u * sign) @ vt
    poses = np.tile(pose, (len(goals), 1))
    poses[:, :3] = b.mean(axis=1) - rotation @ a.mean(axis=0)
    poses[:, 3:7] = matrix_to_quat(rotation)
    return poses


@cache
def _table() -> dict[str, Any]:
    """Content of the file with the map."""
    text = files("handtrack.evaluation").joinpath(TABLE).read_text(encoding="utf-8")
    table = json.loads(text)
    if len(table["joints"]) != NYU_COUNT:
        raise InputError(f"{TABLE} holds {len(table['joints'])} joints, expected {NYU_COUNT}")
    return table
