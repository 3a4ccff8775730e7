"""One regression tree, grown level by level on a device (thesis II.4; Criminisi and Shotton)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from handtrack.forest.artifact import ForestStage
from handtrack.forest.config import ForestConfig
from handtrack.kernels.forest_growth import (
    NSCORE,
    draw_candidates,
    judge_candidates,
    route_samples,
    vec_score,
)

VALUE_STEP = 1e-5
"""Depths at reference points are kept in steps of so much while trees grow [m]."""

MODE_ROUNDS = 8
"""Rounds of k-means in the leaves."""

MODE_APART = 0.012
"""Modes of a leaf whose points are closer than this on average become one [m]."""

_LEVEL_CANDIDATES = 2_000_000
"""Candidates judged in one launch; levels with more nodes take several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """What all trees of a part and stage learn from."""

    values: wp.array
    """Depths at the reference points in `VALUE_STEP`, shape (npoint, nsample) int16."""
    targets: NDArray[np.float32]
    """Displacements that are wanted [m], shape (nsample, ntarget, 3)."""
    components: NDArray[np.float32]
    """Their principal components, on which splits are judged, shape (nsample, NSCORE)."""

    @classmethod
    def of(cls, values: wp.array, targets: NDArray[np.float32]) -> Samples:
        """Prepare samples."""
        flat = targets.reshape(len(targets), -1).astype(np.float64)
        flat = flat - flat.mean(axis=0)
        # A part of the samples tells the axes well enough.
        some = flat[:: max(1, len(flat) // 20000)]
        _, vectors = np.linalg.eigh(some.T @ some)
        kept = vectors[:, ::-1][:, :NSCORE]
        components = np.zeros((len(flat), NSCORE), np.float32)
        components[:, : kept.shape[1]] = flat @ kept
        return cls(values=values, targets=targets, components=components)


def grow_tree(
    samples: Samples, bag: NDArray[np.int64], config: ForestConfig, *, part: int, modes: int,
    seed: int,
) -> ForestStage:  # fmt: skip
    """Grow a tree.

    Args:
        samples: The samples.
        bag: Which of them it learns from, shape (n,).
        config: Depth, leaf size and candidates.
        part: Part that the tree belongs to.
        modes: Modes kept per leaf.
        seed: Seed of the features.

    Returns:
        A stage that holds this tree alone, without reference points.
    """
    device = samples.values.device
    node_points: list[NDArray] = [np.zeros((1, 2), np.int32)]
    thresholds: list[NDArray] = [np.zeros(1, np.float32)]
    children: list[NDArray] = [np.full(1, -1, np.int64)]
    order = bag.astype(np.int32)
    starts = np.array([0, len(order)])
    ended: list[NDArray] = []
    node_count, leaf_count = 1, 0
    for level in range(config.depth + 1):
        points, limits, splits = _split_nodes(samples, order, starts, config, level, seed)
        nodes = np.repeat(np.arange(len(splits)), np.diff(starts)).astype(np.int32)
        right = wp.zeros(len(order), dtype=int, device=device)
        route_samples(
            samples.values, _put(order, device), _put(nodes, device), _put(points, device),
            _put(limits, device), goes_right=right,
        )  # fmt: skip
        # Children of the nodes that split lie side by side behind all nodes so far.
        child = np.full(len(splits), -1, np.int64)
        child[splits] = node_count + 2 * np.arange(splits.sum())
        child[~splits] = -1 - (leaf_count + np.arange((~splits).sum()))
        node_points[-1], thresholds[-1] = points, (limits * VALUE_STEP).astype(np.float32)
        children[-1] = child
        inner = splits[nodes]
        leaf_of = -1 - child[nodes[~inner]]
        ended.append(np.stack([order[~inner], leaf_of]))
        leaf_count += int((~splits).sum())
        if not splits.any():
            break
        number = (np.cumsum(splits) - 1)[nodes[inner]]
        target = 2 * number + right.numpy()[inner]
        sort = np.argsort(target, kind="stable")
        order = order[inner][sort]
        starts = np.concatenate([[0], np.cumsum(np.bincount(target, minlength=2 * splits.sum()))])
        width = 2 * int(splits.sum())
        node_count += width
        node_points.append(np.zeros((width, 2), np.int32))
        thresholds.append(np.zeros(width, np.float32))
        children.append(np.zeros(width, np.int64))
    rows, leaves = np.concatenate(ended, axis=1)
    updates, weights = leaf_modes(samples.targets[rows], leaves, leaf_count, modes)
    npoint = samples.targets.shape[1]
    return ForestStage(
        anchors=np.zeros((0, 0), np.int32), offsets=np.zeros((0, 0, 3), np.float32),
        tree_parts=np.array([part], np.int32), roots=np.zeros(1, np.int32),
        node_points=np.concatenate(node_points), thresholds=np.concatenate(thresholds),
        children=np.concatenate(children).astype(np.int32),
        updates=updates.reshape(leaf_count, modes, npoint, 3), leaf_weights=weights,
    )  # fmt: skip


def _put(values: NDArray, device: Any) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)


def _split_nodes(
    samples: Samples, order: NDArray, starts: NDArray, config: ForestConfig, level: int, seed: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Best feature and threshold of every node, and whether it splits."""
    device, count = samples.values.device, len(starts) - 1
    points = np.zeros((count, 2), np.int32)
    limits = np.ones(count, np.int32)
    splits = np.zeros(count, bool)
    if level == config.depth:
        return points, limits, splits
    batch = max(1, _LEVEL_CANDIDATES // config.candidates)
    targets = wp.array(samples.components[order], dtype=vec_score, device=device)
    sorted_samples = _put(order, device)
    for first in range(0, count, batch):
        part = slice(first, min(first + batch, count))
        shape = (part.stop - first, config.candidates)
        borders = _put(starts[first : part.stop + 1], device)
        drawn = wp.zeros((*shape, 2), dtype=int, device=device)
        tried = wp.zeros(shape, dtype=int, device=device)
        gains = wp.zeros(shape, dtype=float, device=device)
        draw_candidates(
            samples.values, sorted_samples, borders,
            seed=int(np.random.SeedSequence([seed, level, first]).generate_state(1)[0] >> 1),
            points=drawn, thresholds=tried,
        )  # fmt: skip
        judge_candidates(
            samples.values, targets, sorted_samples, borders, drawn, tried,
            most=config.node_samples, min_leaf=config.min_leaf, gains=gains,
        )  # fmt: skip
        found = gains.numpy()
        best = found.argmax(axis=1)
        rows = np.arange(shape[0])
        splits[part] = found[rows, best] > 0
        points[part] = np.where(splits[part, None], drawn.numpy()[rows, best], 0)
        limits[part] = np.where(splits[part], tried.numpy()[rows, best], 1)
    return points, limits, splits


def leaf_modes(
    targets: NDArray[np.float32], leaves: NDArray, count: int, modes: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Means of each leaf's samples, or of its clusters (II.4.3).

    Args:
        targets: Displacements [m], shape (nsample, npoint, 3).
        leaves: Leaf of each sample, shape (nsample,).
        count: Number of leaves.
        modes: Clusters per leaf at most.

    Returns:
        Displacements, shape (count, modes, npoint * 3), and the clusters' shares of the samples,
        shape (count, modes); 0 for clusters that are not there.
    """
    flat = targets.reshape(len(targets), -1).astype(np.float64)
    width = flat.shape[1]

    def means(group: NDArray, number: int) -> tuple[NDArray, NDArray]:
        matrix = csr_matrix(
            (np.ones(len(group)), (group, np.arange(len(group)))), (number, len(group))
        )
        sizes = np.bincount(group, minlength=number)
        return (matrix @ flat) / np.maximum(sizes, 1)[:, None], sizes

    centre, sizes = means(leaves, count)
    updates = np.repeat(centre[:, None], modes, axis=1)
    weights = np.zeros((count, modes))
    weights[:, 0] = 1.0
    if modes == 1:
        return updates.astype(np.float32), weights.astype(np.float32)
    # Farthest samples first: the first two centres are the leaf's farthest sample and that
    # farthest from it, and so on.
    chosen = [_farthest(((flat - centre[leaves]) ** 2).sum(1), leaves, count)]
    gap = np.full(len(flat), np.inf)
    for _ in range(modes - 1):
        gap = np.minimum(gap, ((flat - flat[chosen[-1]][leaves]) ** 2).sum(1))
        chosen.append(_farthest(gap, leaves, count))
    centres = np.stack([flat[one] for one in chosen], axis=1)
    share = np.zeros((count, modes))
    for _ in range(MODE_ROUNDS):
        distance = np.stack([((flat - centres[leaves, m]) ** 2).sum(1) for m in range(modes)], 1)
        nearest = distance.argmin(axis=1)
        found, number = means(leaves * modes + nearest, count * modes)
        found, number = found.reshape(count, modes, width), number.reshape(count, modes)
        centres = np.where(number[..., None] > 0, found, centres)
        share = number / np.maximum(sizes, 1)[:, None]
    # One mode where the clusters are hardly apart.
    spread = np.linalg.norm((centres - centre[:, None]).reshape(count, modes, -1, 3), axis=-1)
    several = (spread.mean(axis=2) * (share > 0)).max(axis=1) > MODE_APART / 2
    updates[several], weights[several] = centres[several], share[several]
    return updates.astype(np.float32), weights.astype(np.float32)


def _farthest(distance: NDArray, leaves: NDArray, count: int) -> NDArray[np.int64]:
    """Sample of the largest distance in each leaf, shape (count,)."""
    order = np.lexsort((distance, leaves))
    last = np.searchsorted(leaves[order], np.arange(count), side="right") - 1
    return order[last]
