"""The regression forest by the thesis' words (II.4): one point, one tree, one vote at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.hand.model import ShapedHand

Float = NDArray[np.float64]

NEAREST = 0.02
"""Points closer to the camera's plane than this project nowhere [m]."""

BASES = (1, 4, 7, 10, 13)
"""Root bone of each finger."""


def seen_point(
    cells: Float, camera: Float, gate: Float, mirror: float, row: int, column: int
) -> tuple[Float | None, float]:
    """What a cell shows of the hand, and how far that is from being decided otherwise.

    Args:
        cells: z [m]; background and unknown cells are not positive and finite, shape (n, n).
        camera: fx, fy, cx, cy [cells].
        gate: Centre and radius of the ball that holds the hand, mirrored frame [m].
        mirror: -1 when the picture is looked at in a mirror.
        row: Row of the cell.
        column: Column of the cell.

    Returns:
        The point [m], mirrored frame, or None; its distance from the gate's surface [m].
    """
    z = cells[row, column]
    if not np.isfinite(z) or z <= 0:
        return None, np.inf
    fx, fy, cx, cy = camera[:4]
    ray = np.linalg.solve(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), [column, row, 1.0])
    point = z * ray * [mirror, 1.0, 1.0]
    inside = gate[3] - np.linalg.norm(point - gate[:3])
    return (point if inside >= 0 else None), abs(inside)


def depth_value(
    point: Float, place: Float, cells: Float, camera: Float, gate: Float, *, mirror: float,
    depth_range: float,
) -> tuple[float, float, float]:  # fmt: skip
    """I(CamProj(point)) of Eq. II.15 against the depth of the part's origin.

    Returns:
        The value [m]; background, unknown cells and what is outside count as far behind. Then how
        far the pixel is from the cell's border [cells], and its point from the gate's surface [m].
    """
    if point[2] <= NEAREST:
        return depth_range, np.inf, np.inf
    fx, fy, cx, cy = camera[:4]
    projection = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixel = projection @ (point * [mirror, 1.0, 1.0] / point[2])
    nearest = np.floor(pixel[:2] + 0.5)
    margin = float(0.5 - np.abs(pixel[:2] - nearest).max())
    column, row = nearest
    if not (0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]):
        return depth_range, margin, np.inf
    seen, gap = seen_point(cells, camera, gate, mirror, int(row), int(column))
    if seen is None:
        return depth_range, margin, gap
    return float(np.clip(seen[2] - place[2], -depth_range, depth_range)), margin, gap


def gated_points(cells: Float, camera: Float, gate: Float, mirror: float, stride: int) -> Float:
    """All points of the hand in every stride-th row and column [m], shape (n, 3).

    Columns are counted from the left of what is looked at: of the mirrored image in a mirror.
    """
    rows, columns = (np.arange(size // stride) * stride for size in cells.shape)
    columns = columns if mirror > 0 else cells.shape[1] - 1 - columns
    grid = [(row, column) for row in rows for column in columns]
    seen = [seen_point(cells, camera, gate, mirror, row, column)[0] for row, column in grid]
    return np.array([point for point in seen if point is not None]).reshape(-1, 3)


def start_palms(points: Float, middle: Float) -> list[tuple[Float, Float]]:
    """The four palms that the principal axes of points allow (II.4.2).

    Args:
        points: What is seen of the hand [m], shape (n, 3).
        middle: The middle finger's knuckle in the palm's frame [m].

    Returns:
        Rotations, whose x is the longest and whose y is the shortest axis, and origins [m].
    """
    mean = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - mean).T @ (points - mean))
    palms = []
    for x in (axes[:, 2], -axes[:, 2]):
        for y in (axes[:, 0], -axes[:, 0]):
            rotation = np.column_stack([x, y, np.cross(x, y)])
            palms.append((rotation, mean - rotation @ middle))
    return palms


def leaf_of(
    node: int, node_points: NDArray, thresholds: Float, children: NDArray, values: Float
) -> int:
    """Leaf below a node: left where the difference of two depths is below the threshold."""
    if children[node] < 0:
        return -1 - int(children[node])
    first, second = node_points[node]
    right = not values[first] - values[second] < thresholds[node]
    return leaf_of(int(children[node]) + right, node_points, thresholds, children, values)


def greedy_modes(
    votes: Float, weights: Float, radius: float, count: int
) -> tuple[list[Float], list[float]]:
    """Centres of the votes' clusters, the densest first (II.4.3).

    Args:
        votes: Voted points [m], shape (nvote, npoint, 3).
        weights: Weight of each vote, shape (nvote,).
        radius: Votes closer than this on average belong together [m].
        count: Clusters at most.
    """
    distance = np.linalg.norm(votes[:, None] - votes[None], axis=-1).mean(axis=-1)
    shares = np.where(distance < radius, 1.0 - (distance / radius) ** 2, 0.0) * weights
    density = np.where(weights > 0, shares.sum(axis=1), 0.0)
    modes: list[Float] = []
    heights: list[float] = []
    while len(modes) < count and density.max() > 0:
        best = int(density.argmax())
        modes.append(np.einsum("v,vki->ki", shares[best], votes) / shares[best].sum())
        heights.append(float(density[best]))
        density[distance[best] < radius] = 0.0
    return modes, heights


def laid_palm(source: Float, goal: Float) -> tuple[Float, Float]:
    """Rotation and translation that lay points on others by least squares (Kabsch)."""
    centre, target = source.mean(axis=0), goal.mean(axis=0)
    rotation, _ = Rotation.align_vectors(goal - target, source - centre)
    matrix = rotation.as_matrix()
    return matrix, target - matrix @ centre


def root_frames(hand: ShapedHand, pose: Float) -> tuple[Float, Float]:
    """Frames of the finger roots when all angles are zero, (5, 3, 3) and (5, 3) (II.4.2)."""
    straight = np.concatenate([pose[:7], np.zeros(21)])
    rotations, origins = bone_frames(hand, straight)
    return rotations[list(BASES)], origins[list(BASES)]


def finger_joints(hand: ShapedHand, pose: Float) -> Float:
    """The three outer joints of every finger in its root's frame [m], shape (5, 3, 3)."""
    rotations, origins = root_frames(hand, pose)
    joints = keypoints(hand, pose)[1:].reshape(5, 4, 3)[:, 1:]
    return np.einsum("fji,fkj->fki", rotations, joints - origins[:, None])


def split_gain(left: NDArray[np.bool_], targets: Float) -> float:
    """Fall of the targets' variance by a split in two."""

    def scatter(part: Float) -> float:
        return float(((part - part.mean(axis=0)) ** 2).sum()) if len(part) else 0.0

    apart = scatter(targets[left]) + scatter(targets[~left])
    return (scatter(targets) - apart) / len(targets)
