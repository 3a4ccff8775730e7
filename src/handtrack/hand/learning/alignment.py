"""First pose of a scan that lies anywhere: named angles, then place, turn and size.

The hand in the pose that the subject was asked for is laid on the scan by its principal axes, in
all 24 ways that axes go on axes, and each way is improved by rigid ICP with a free size; the one
that leaves the least is taken. No manual step, and no frame that a scanner would have to keep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from handtrack.hand.learning.correspondence import described
from handtrack.hand.learning.posed_template import PosedTemplate, SubjectShape, Template
from handtrack.hand.learning.scans import Scan
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

_POINTS, _SCAN_POINTS = 400, 2000
"""Vertices and scan points used; more changes nothing here."""
_FIRST_ROUNDS, _ROUNDS, _KEPT = 4, 12, 5
"""Rounds of ICP for every way, and then for the few best ones."""
_SURE = 0.015
"""Distance [m], both ways, from which the ways are not believed, and others between them tried:
right ones leave 9 to 14 mm before fingers and proportions are fitted, wrong ones 15 to 30 mm."""
_ASIDE = np.radians(25.0)
"""How far those others are turned [rad]."""
_TRIM = 0.8
"""Share of the matches that may count: scans have holes, and arms of other lengths."""


def first_pose(
    template: Template, shape: SubjectShape, scan: Scan, angles: Float
) -> tuple[Float, float]:
    """Find where a scanned hand is.

    Args:
        template: The template.
        shape: Shape to lay on the scan.
        scan: The scan.
        angles: Angles of the pose that it was asked for [rad], shape (21,).

    Returns:
        Pose, shape (28,), and size relative to the shape.
    """
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])
    posed = PosedTemplate(template, shape, pose[None])
    vertices, normals = posed.vertices[0], posed.normals[0]
    if scan.registered:
        size, turn, place = _similarity(vertices, scan.points)
        return _as_pose(turn, place, angles), size

    ways = _Ways(vertices, normals, scan)
    tried = [ways.improve(way, _FIRST_ROUNDS, resize=False) for way in ways.all()]
    tried.sort(key=lambda way: way.left)
    kept = [ways.improve(way, _ROUNDS, resize=True) for way in tried[:_KEPT]]
    if min(way.left for way in kept) > _SURE:
        kept += [ways.improve(way, _ROUNDS, resize=True) for way in ways.around(tried[:_KEPT])]
    best = min(kept, key=lambda way: way.left)
    return _as_pose(best.turn, best.place, angles), best.size


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """One way of laying the hand on the scan: x -> size turn x + place."""

    size: float
    turn: Float
    place: Float
    left: float = np.inf
    """Distance that is left, both ways [m]."""


class _Ways:
    """Rigid ICP with a free size from many starts."""

    def __init__(self, vertices: Float, normals: Float, scan: Scan) -> None:
        rng = np.random.default_rng(0)
        own = rng.choice(len(vertices), min(_POINTS, len(vertices)), replace=False)
        seen = rng.choice(len(scan.points), min(_SCAN_POINTS, len(scan.points)), replace=False)
        self._source, self._source_normals = vertices[own], normals[own]
        self._goal, self._goal_normals = scan.points[seen], scan.normals[seen]
        self._tree = KDTree(described(self._goal, self._goal_normals))
        self._ratio = float(np.sqrt(self._goal.var(axis=0).sum() / self._source.var(axis=0).sum()))

    def all(self) -> list[_Way]:
        """Principal axes on principal axes, in all right-handed ways."""
        axes, goal_axes = _principal_axes(self._source), _principal_axes(self._goal)
        ways = []
        for swap in Rotation.create_group("O").as_matrix():
            turn = goal_axes @ swap @ axes.T
            place = self._goal.mean(axis=0) - self._ratio * turn @ self._source.mean(axis=0)
            ways.append(_Way(size=self._ratio, turn=turn, place=place))
        return ways

    def around(self, ways: Sequence[_Way]) -> list[_Way]:
        """Ways turned a little about each principal axis of the scan."""
        axes, middle = _principal_axes(self._goal), self._goal.mean(axis=0)
        turned = []
        for way in ways:
            for turn in Rotation.from_rotvec(_ASIDE * np.vstack([axes.T, -axes.T])).as_matrix():
                place = middle + turn @ (way.place - middle)
                turned.append(replace(way, turn=turn @ way.turn, place=place))
        return turned

    def improve(self, way: _Way, rounds: int, *, resize: bool) -> _Way:
        """Lay the hand better, and say what is left."""
        size, turn, place = way.size, way.turn, way.place
        for _ in range(rounds):
            found = self._tree.query(self._moved(size, turn, place))
            distance, nearest = np.asarray(found[0]), np.asarray(found[1])
            kept = distance <= np.quantile(distance, _TRIM)
            source, goal = self._source[kept], self._goal[nearest[kept]]
            wanted, turn, _ = _similarity(source, goal)
            if resize:
                # Laid wrongly, a hand would shrink until it meets something.
                size = float(np.clip(wanted, 0.8 * self._ratio, 1.25 * self._ratio))
            place = goal.mean(axis=0) - size * turn @ source.mean(axis=0)
        moved = self._moved(size, turn, place)
        # Fingers laid on other fingers leave some of the scan alone: ask both sides.
        asking = described(self._goal[:_POINTS], self._goal_normals[:_POINTS])
        left = _trimmed_mean(np.asarray(self._tree.query(moved)[0]))
        left += _trimmed_mean(np.asarray(KDTree(moved).query(asking)[0]))
        return _Way(size=size, turn=turn, place=place, left=left)

    def _moved(self, size: float, turn: Float, place: Float) -> Float:
        """What is searched for: points of the hand, laid so, with their normals."""
        return described(size * self._source @ turn.T + place, self._source_normals @ turn.T)


def _trimmed_mean(distances: Float) -> float:
    return float(distances[distances <= np.quantile(distances, _TRIM)].mean())


def _as_pose(turn: Float, place: Float, angles: Float) -> Float:
    """Pose vector whose palm frame is turned and placed so."""
    return np.concatenate([place, matrix_to_quat(turn), angles])


def _principal_axes(points: Float) -> Float:
    """Right-handed principal axes, columns, shape (3, 3)."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    axes[:, 2] *= np.linalg.det(axes)
    return axes


def _similarity(source: Float, goal: Float) -> tuple[float, Float, Float]:
    """Size, rotation and translation with goal = size R source + t, least squares."""
    found = trimesh.registration.procrustes(source, goal, reflection=False, return_cost=False)
    matrix = np.asarray(found, np.float64)
    size = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return size, matrix[:3, :3] / size, matrix[:3, 3]
