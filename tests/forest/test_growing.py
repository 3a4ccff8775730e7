"""Trees on toy problems whose best answer is known, and the modes of their leaves (II.4.3)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.forest.artifact import ForestStage
from handtrack.forest.config import ForestConfig
from handtrack.forest.growing import MODE_APART, VALUE_STEP, Samples, grow_tree, leaf_modes
from handtrack.kernels.forest_growth import NSCORE
from oracles.forest import leaf_of

Float = NDArray[np.float64]

STEP = 1000
"""Difference of depths that separates the toy problem's two groups, in `VALUE_STEP`."""


@dataclass(frozen=True)
class Toy:
    """Samples whose group shows in the depths at two of the points and nowhere else."""

    values: NDArray[np.int16]
    targets: NDArray[np.float32]
    group: NDArray[np.int64]

    @classmethod
    def random(cls, rng: np.random.Generator, count: int = 400, *, noise: float = 0.001) -> Toy:
        values = rng.integers(-9000, 9000, (8, count)).astype(np.int16)
        group = rng.integers(0, 2, count)
        values[2] = values[5] + STEP * group
        targets = rng.normal(0.0, noise, (count, 3, 3))
        targets[:, 1] += group[:, None] * np.array([0.05, 0.0, -0.02])
        return cls(values=values, targets=targets.astype(np.float32), group=group)

    def samples(self, device: str) -> Samples:
        return Samples.of(wp.array(self.values, dtype=wp.int16, device=device), self.targets)

    def leaves(self, tree: ForestStage, rows: NDArray) -> NDArray[np.int64]:
        # In whole steps, as trees grow: equal numbers are equal.
        steps, limits = self.values.astype(int), np.rint(tree.thresholds / VALUE_STEP)
        root = int(tree.roots[0])
        return np.array([
            leaf_of(root, tree.node_points, limits, tree.children, steps[:, row]) for row in rows
        ])  # fmt: skip


def config(**changes: object) -> ForestConfig:
    settings = {"depth": 6, "min_leaf": 5, "candidates": 600, "points": 8, **changes}
    return ForestConfig(**settings)


def depth_of(tree: ForestStage, node: int = 0) -> int:
    child = int(tree.children[node])
    return 0 if child < 0 else 1 + max(depth_of(tree, child), depth_of(tree, child + 1))


def test_a_tree_finds_the_split_that_explains_all(device, rng) -> None:
    toy = Toy.random(rng)
    bag = np.arange(400)
    tree = grow_tree(toy.samples(device), bag, config(depth=1), part=3, modes=1, seed=7)
    assert set(tree.node_points[0]) == {2, 5}
    assert 0 < abs(tree.thresholds[0]) <= STEP * VALUE_STEP * (1 + 1e-6)
    leaves = toy.leaves(tree, bag)
    assert len(tree.updates) == 2 and (len(set(leaves[toy.group == 0])) == 1)
    for group in (0, 1):
        mine = toy.group == group
        leaf = leaves[mine][0]
        assert (leaves[mine] == leaf).all(), "each group has a leaf of its own"
        np.testing.assert_allclose(tree.updates[leaf, 0], toy.targets[mine].mean(axis=0), atol=1e-7)
    np.testing.assert_array_equal(tree.tree_parts, [3])
    np.testing.assert_array_equal(tree.leaf_weights, 1.0)
    kinds = {field.name: getattr(tree, field.name).dtype for field in fields(ForestStage)}
    assert set(kinds.values()) == {np.dtype(np.int32), np.dtype(np.float32)}, kinds


def test_the_best_split_is_found_on_a_part_of_the_samples(device, rng) -> None:
    toy = Toy.random(rng)
    tree = grow_tree(
        toy.samples(device), np.arange(400), config(depth=1, node_samples=60), part=0, modes=1,
        seed=7,
    )  # fmt: skip
    assert set(tree.node_points[0]) == {2, 5}


def test_leaves_hold_the_means_of_what_the_tree_saw(device, rng) -> None:
    toy = Toy.random(rng, noise=0.01)
    bag = np.flatnonzero(rng.random(400) < 0.6)
    tree = grow_tree(toy.samples(device), bag, config(), part=0, modes=1, seed=1)
    leaves = toy.leaves(tree, bag)
    assert set(leaves) == set(range(len(tree.updates)))
    for leaf in range(len(tree.updates)):
        mean = toy.targets[bag[leaves == leaf]].mean(axis=0)
        np.testing.assert_allclose(tree.updates[leaf, 0], mean, atol=1e-7)


@pytest.mark.parametrize("min_leaf", [1, 10, 60])
@pytest.mark.parametrize("depth", [1, 3, 8])
def test_leaves_are_large_enough_and_trees_not_too_deep(device, rng, min_leaf, depth) -> None:
    toy = Toy.random(rng, noise=0.02)
    bag = np.arange(400)
    tree = grow_tree(
        toy.samples(device), bag, config(min_leaf=min_leaf, depth=depth, candidates=30), part=0,
        modes=1, seed=3,
    )  # fmt: skip
    assert np.bincount(toy.leaves(tree, bag), minlength=len(tree.updates)).min() >= min_leaf
    assert depth_of(tree) <= depth
    inner = tree.children >= 0
    assert (tree.children[inner] > np.flatnonzero(inner)).all()
    assert inner.sum() + 1 == len(tree.updates)


@pytest.mark.parametrize("kind", ["few samples", "equal depths", "equal targets"])
def test_samples_that_cannot_be_told_apart_stay_in_one_leaf(device, rng, kind) -> None:
    toy = Toy.random(rng)
    bag = np.arange(400)
    if kind == "few samples":
        bag = bag[:9]
    elif kind == "equal depths":
        toy.values[:] = 5
    else:
        toy.targets[:] = 0.25
    tree = grow_tree(toy.samples(device), bag, config(), part=0, modes=1, seed=0)
    assert tree.children.tolist() == [-1] and tree.node_points.tolist() == [[0, 0]]
    np.testing.assert_allclose(tree.updates[0, 0], toy.targets[bag].mean(axis=0), atol=1e-7)


def test_a_tree_follows_from_its_seed(device, rng) -> None:
    toy = Toy.random(rng, noise=0.02)
    samples, bag = toy.samples(device), np.arange(400)
    trees = [
        grow_tree(samples, bag, config(candidates=20), part=0, modes=2, seed=s) for s in (4, 4, 5)
    ]
    for field in fields(ForestStage):
        np.testing.assert_array_equal(*(getattr(tree, field.name) for tree in trees[:2]))
    assert trees[0].node_points.tolist() != trees[2].node_points.tolist()


def test_components_keep_the_variance_of_the_targets(rng) -> None:
    basis = rng.standard_normal((NSCORE, 45))
    targets = (rng.standard_normal((300, NSCORE)) @ basis).reshape(300, 15, 3) + 7.0
    samples = Samples.of(None, targets.astype(np.float32))
    flat = targets.reshape(300, -1)
    spread = ((flat - flat.mean(axis=0)) ** 2).sum()
    assert (samples.components**2).sum() == pytest.approx(spread, rel=1e-4)
    few = Samples.of(None, targets[:, :1].astype(np.float32))
    assert few.components.shape == (300, NSCORE), "fewer targets than components leave zeros"
    np.testing.assert_array_equal(few.components[:, 3:], 0.0)


def test_two_clusters_become_two_modes_with_their_shares(rng) -> None:
    sizes = {0: (30, 70), 1: (50, 50), 2: (5, 15)}
    targets, leaves, centres = [], [], {}
    for leaf, counts in sizes.items():
        centres[leaf] = rng.normal(0.0, 0.04, (2, 6, 3))
        for centre, count in zip(centres[leaf], counts, strict=True):
            targets.append(centre + rng.normal(0.0, 0.001, (count, 6, 3)))
            leaves += [leaf] * count
    order = rng.permutation(len(leaves))
    updates, weights = leaf_modes(
        np.concatenate(targets)[order].astype(np.float32), np.array(leaves)[order], 3, 2
    )
    for leaf, counts in sizes.items():
        first = np.argmin(np.linalg.norm(updates[leaf] - centres[leaf][0].ravel(), axis=1))
        found = updates[leaf, [first, 1 - first]].reshape(2, 6, 3)
        # Means of at least five samples with a deviation of a millimetre.
        np.testing.assert_allclose(found, centres[leaf], atol=0.002)
        np.testing.assert_allclose(
            weights[leaf, [first, 1 - first]], np.array(counts) / sum(counts), atol=1e-6
        )


def test_three_clusters_become_three_modes(rng) -> None:
    centres = np.array([-0.05, 0.0, 0.06])
    targets = np.repeat(centres, (20, 30, 50))[:, None, None] + rng.normal(0, 1e-3, (100, 4, 3))
    updates, weights = leaf_modes(targets.astype(np.float32), np.zeros(100, int), 1, 3)
    order = updates[0].mean(axis=1).argsort()
    np.testing.assert_allclose(updates[0, order].mean(axis=1), centres, atol=0.001)
    np.testing.assert_allclose(weights[0, order], [0.2, 0.3, 0.5], atol=1e-6)


def test_one_cluster_becomes_one_mode(rng) -> None:
    targets = (0.03 + rng.normal(0.0, 0.001, (80, 6, 3))).astype(np.float32)
    leaves = rng.integers(0, 2, 80)
    updates, weights = leaf_modes(targets, leaves, 2, 2)
    np.testing.assert_array_equal(weights, [[1.0, 0.0]] * 2)
    for leaf in (0, 1):
        mean = targets[leaves == leaf].mean(axis=0).ravel()
        np.testing.assert_allclose(updates[leaf], [mean, mean], atol=1e-7)


@pytest.mark.parametrize(("apart", "count"), [(0.9, 1), (1.1, 2)])
def test_modes_closer_than_told_become_one(rng, apart: float, count: int) -> None:
    direction = np.array([0.6, 0.0, 0.8])
    steps = np.repeat([0.0, apart * MODE_APART], 50)
    targets = steps[:, None, None] * direction + rng.normal(0.0, 1e-5, (100, 6, 3))
    _, weights = leaf_modes(targets.astype(np.float32), np.zeros(100, int), 1, 2)
    assert (weights[0] > 0).sum() == count


@pytest.mark.parametrize("modes", [1, 2, 4])
def test_leaves_of_one_or_equal_samples_have_one_mode(modes: int) -> None:
    targets = np.full((5, 2, 3), 0.02, np.float32)
    updates, weights = leaf_modes(targets, np.array([0, 1, 1, 1, 1]), 2, modes)
    np.testing.assert_allclose(updates, 0.02, atol=1e-8)
    np.testing.assert_array_equal(weights, np.eye(1, modes).repeat(2, axis=0))
