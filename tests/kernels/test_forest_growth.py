"""Candidates of a node: drawn, judged by the fall of variance, and applied."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.kernels.forest_growth import (
    NSCORE,
    draw_candidates,
    judge_candidates,
    route_samples,
    vec_score,
)
from oracles.device_arrays import download, poisoned, upload
from oracles.forest import split_gain
from oracles.scenes import rounded

Float = NDArray[np.float64]

GAIN_TOLERANCE = 1e-4
"""Sums of squares in float32 that nearly cancel, against a variance of 1 per component."""


class Node:
    """Random samples of several nodes, in an order of their own."""

    def __init__(
        self, rng: np.random.Generator, sizes: tuple[int, ...] = (40, 3, 100, 1, 17, 64, 250)
    ) -> None:
        nsample, self.npoint = sum(sizes) + 20, 12
        self.values = rng.integers(-12000, 12000, (self.npoint, nsample)).astype(np.int16)
        # Extremes of the type: their difference needs more bits than they have.
        self.values[3, ::2], self.values[4, ::2] = 32767, -32768
        self.order = rng.permutation(nsample)[: sum(sizes)]
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.targets = rounded(rng.standard_normal((sum(sizes), NSCORE)))

    @property
    def count(self) -> int:
        return len(self.starts) - 1

    def samples(self, node: int) -> NDArray:
        return self.order[self.starts[node] : self.starts[node + 1]]

    def differences(self, node: int, points: NDArray) -> NDArray:
        one, other = self.values[points].astype(int)[:, self.samples(node)]
        return one - other

    def uploaded(self, device: str) -> wp.array:
        return wp.array(self.values, dtype=wp.int16, device=device)

    def draw(self, device: str, count: int, seed: int) -> tuple[NDArray, NDArray]:
        points = poisoned((self.count, count, 2), device, int)
        thresholds = poisoned((self.count, count), device, int)
        draw_candidates(
            self.uploaded(device), upload(self.order, device), upload(self.starts, device),
            seed=seed, points=points, thresholds=thresholds,
        )  # fmt: skip
        return download(points), download(thresholds)

    def judge(
        self, device: str, points: NDArray, thresholds: NDArray, *, most: int = 10000,
        min_leaf: int = 1,
    ) -> Float:  # fmt: skip
        gains = poisoned(thresholds.shape, device)
        judge_candidates(
            self.uploaded(device), upload(self.targets, device, vec_score),
            upload(self.order, device), upload(self.starts, device), upload(points, device),
            upload(thresholds, device), most=most, min_leaf=min_leaf, gains=gains,
        )  # fmt: skip
        return download(gains)


def test_candidates_are_pairs_of_points_and_a_samples_difference(device, rng) -> None:
    nodes = Node(rng)
    points, thresholds = nodes.draw(device, 500, 7)
    assert points.min() == 0 and points.max() == nodes.npoint - 1
    assert (points[..., 0] != points[..., 1]).all()
    for node in range(nodes.count):
        above = []
        for pair, threshold in zip(points[node], thresholds[node], strict=True):
            differences = nodes.differences(node, pair)
            assert threshold in differences or threshold - 1 in differences
            above.append(threshold - 1 in differences)
        assert 0.35 < np.mean(above) < 0.65, "half of the thresholds leave their sample left"


def test_candidates_follow_from_the_seed(device, rng) -> None:
    nodes = Node(rng)
    points, thresholds = nodes.draw(device, 50, 1)
    again = nodes.draw(device, 50, 1)
    np.testing.assert_array_equal(again[0], points)
    np.testing.assert_array_equal(again[1], thresholds)
    other = nodes.draw(device, 50, 2)
    assert (other[0] != points).mean() > 0.5
    assert (points[0] != points[2]).any(), "nodes draw features of their own"


def test_all_pairs_of_points_are_drawn(device, rng) -> None:
    nodes = Node(rng)
    points, _ = nodes.draw(device, 4000, 3)
    assert len(np.unique(points[0] @ [100, 1])) == nodes.npoint * (nodes.npoint - 1)


@pytest.mark.parametrize("min_leaf", [1, 5, 30])
def test_gains_equal_the_fall_of_variance(device, rng, min_leaf) -> None:
    nodes = Node(rng)
    points, thresholds = nodes.draw(device, 60, 11)
    gains = nodes.judge(device, points, thresholds, min_leaf=min_leaf)
    useless = 0
    for node, candidate in np.ndindex(gains.shape):
        left = nodes.differences(node, points[node, candidate]) < thresholds[node, candidate]
        if min(left.sum(), (~left).sum()) < min_leaf:
            assert gains[node, candidate] == -1.0
            useless += 1
        else:
            targets = nodes.targets[nodes.starts[node] : nodes.starts[node + 1]]
            expected = split_gain(left, targets)
            assert gains[node, candidate] == pytest.approx(expected, abs=GAIN_TOLERANCE)
    assert 0 < useless < gains.size


def test_large_nodes_are_judged_on_some_of_their_samples(device, rng) -> None:
    nodes = Node(rng)
    points, thresholds = nodes.draw(device, 60, 12)
    gains = nodes.judge(device, points, thresholds, most=50)
    for node in (2, 6):
        seen = slice(None, None, -(-len(nodes.samples(node)) // 50))
        targets = nodes.targets[nodes.starts[node] : nodes.starts[node + 1]][seen]
        for candidate in range(60):
            left = nodes.differences(node, points[node, candidate]) < thresholds[node, candidate]
            left = left[seen]
            if left.any() and not left.all():
                expected = split_gain(left, targets)
                assert gains[node, candidate] == pytest.approx(expected, abs=GAIN_TOLERANCE)
            else:
                assert gains[node, candidate] == -1.0


def test_a_node_of_equal_samples_cannot_split(device, rng) -> None:
    nodes = Node(rng)
    nodes.values[:] = 77
    gains = nodes.judge(device, *nodes.draw(device, 40, 5))
    np.testing.assert_array_equal(gains, -1.0)


def test_a_node_of_one_sample_cannot_split(device, rng) -> None:
    nodes = Node(rng)
    gains = nodes.judge(device, *nodes.draw(device, 40, 5))
    np.testing.assert_array_equal(gains[3], -1.0)
    assert (gains[2] > 0).any()


def test_a_node_alone_is_judged_the_same(device, rng) -> None:
    nodes = Node(rng)
    points, thresholds = nodes.draw(device, 40, 6)
    together = nodes.judge(device, points, thresholds)
    for node in (0, 6):
        alone = Node(rng)
        alone.values = nodes.values
        span = slice(nodes.starts[node], nodes.starts[node + 1])
        alone.order, alone.targets = nodes.order[span], nodes.targets[span]
        alone.starts = np.array([0, len(alone.order)])
        one = slice(node, node + 1)
        found = alone.judge(device, points[one], thresholds[one])
        np.testing.assert_array_equal(found[0], together[node])


def test_samples_go_where_their_difference_says(device, rng) -> None:
    nodes = Node(rng)
    points, thresholds = (drawn[:, 0] for drawn in nodes.draw(device, 1, 8))
    # A node that ends: two equal points and a threshold of 1 send all to the left.
    points[4], thresholds[4] = 0, 1
    owner = np.repeat(np.arange(nodes.count), np.diff(nodes.starts))
    right = poisoned(len(nodes.order), device, int)
    route_samples(
        nodes.uploaded(device), upload(nodes.order, device), upload(owner, device),
        upload(points, device), upload(thresholds, device), goes_right=right,
    )  # fmt: skip
    found = download(right)
    for node in range(nodes.count):
        expected = nodes.differences(node, points[node]) >= thresholds[node]
        np.testing.assert_array_equal(found[owner == node], expected)
    assert not found[owner == 4].any()
    assert 0 < found.mean() < 1
