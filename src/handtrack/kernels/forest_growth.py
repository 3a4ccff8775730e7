"""Growing regression trees level by level: features drawn, judged and applied (II.4, [42, 43]).

A node's samples are consecutive entries of `order`. A candidate is a difference of two reference
points' depths and a threshold; it is judged by how much the split lowers the variance of the
targets, of which `NSCORE` principal components count.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

NSCORE = 12
"""Components of the targets on which splits are judged."""

vec_score = wp.types.vector(length=NSCORE, dtype=float)


@wp.func
def _difference(values_in: wp.array2d[wp.int16], a: int, b: int, sample: int) -> int:
    return int(values_in[a, sample]) - int(values_in[b, sample])


@wp.kernel
def _draw_candidates(
    # in
    values_in: wp.array2d[wp.int16],
    order_in: wp.array[int],
    starts_in: wp.array[int],
    seed: int,
    # out
    points_out: wp.array3d[int],
    thresholds_out: wp.array2d[int],
):
    """One candidate of one node: two reference points, and a sample's difference as threshold."""
    node, candidate = wp.tid()
    state = wp.rand_init(seed, node * points_out.shape[1] + candidate)
    count = values_in.shape[0]
    a = wp.randi(state, 0, count)
    b = (a + wp.randi(state, 1, count)) % count
    start = starts_in[node]
    stop = starts_in[node + 1]
    sample = order_in[start + wp.randi(state, 0, stop - start)]
    points_out[node, candidate, 0] = a
    points_out[node, candidate, 1] = b
    # Strictly between this sample's value and the next smaller one half of the time.
    thresholds_out[node, candidate] = _difference(values_in, a, b, sample) + wp.randi(state, 0, 2)


@wp.kernel
def _judge_candidates(
    # in
    values_in: wp.array2d[wp.int16],
    targets_in: wp.array[vec_score],
    order_in: wp.array[int],
    starts_in: wp.array[int],
    points_in: wp.array3d[int],
    thresholds_in: wp.array2d[int],
    most: int,
    min_leaf: int,
    # out
    gains_out: wp.array2d[float],
):
    """One candidate of one node: fall of the targets' variance, -1 when a side is too small."""
    node, candidate = wp.tid()
    start = starts_in[node]
    count = starts_in[node + 1] - start
    step = wp.max((count + most - 1) // most, 1)
    a = points_in[node, candidate, 0]
    b = points_in[node, candidate, 1]
    threshold = thresholds_in[node, candidate]
    left = vec_score()
    total = vec_score()
    lefts = int(0)
    number = int(0)
    k = start
    while k < start + count:
        target = targets_in[k]
        total += target
        number += 1
        if _difference(values_in, a, b, order_in[k]) < threshold:
            left += target
            lefts += 1
        k += step
    rights = number - lefts
    gains_out[node, candidate] = -1.0
    # The least size is that of the whole node's sides, of which every step-th sample is seen.
    if lefts * step >= min_leaf and rights * step >= min_leaf:
        right = total - left
        gains_out[node, candidate] = (
            wp.dot(left, left) / float(lefts)
            + wp.dot(right, right) / float(rights)
            - wp.dot(total, total) / float(number)
        ) / float(number)


@wp.kernel
def _route_samples(
    # in
    values_in: wp.array2d[wp.int16],
    order_in: wp.array[int],
    nodes_in: wp.array[int],
    points_in: wp.array2d[int],
    thresholds_in: wp.array[int],
    # out
    goes_right_out: wp.array[int],
):
    """One entry of the order: whether its sample goes right in its node.

    Nodes that end have two equal points and a threshold of 1, so that all go left.
    """
    k = wp.tid()
    node = nodes_in[k]
    difference = _difference(values_in, points_in[node, 0], points_in[node, 1], order_in[k])
    goes_right_out[k] = wp.where(difference < thresholds_in[node], 0, 1)


def draw_candidates(
    values: wp.array,
    order: wp.array,
    starts: wp.array,
    *,
    seed: int,
    points: wp.array,
    thresholds: wp.array,
) -> None:
    """Random features of every node.

    Args:
        values: Depths at the reference points in integer steps, shape (npoint, nsample) int16.
        order: Samples sorted by node, shape (norder,).
        starts: First entry of each node, and the end, shape (nnode + 1,).
        seed: Seed of this tree and level.
        points: Out: reference points, shape (nnode, ncandidate, 2).
        thresholds: Out: thresholds in steps, shape (nnode, ncandidate).
    """
    wp.launch(
        _draw_candidates,
        dim=thresholds.shape,
        inputs=[values, order, starts, seed],
        outputs=[points, thresholds],
        device=points.device,
    )


def judge_candidates(
    values: wp.array,
    targets: wp.array,
    order: wp.array,
    starts: wp.array,
    points: wp.array,
    thresholds: wp.array,
    *,
    most: int,
    min_leaf: int,
    gains: wp.array,
) -> None:
    """How much every candidate explains.

    Args:
        values: Depths at the reference points in integer steps, shape (npoint, nsample) int16.
        targets: Components of the targets in the order of `order`, shape (norder,) vec_score.
        order: Samples sorted by node, shape (norder,).
        starts: First entry of each node, and the end, shape (nnode + 1,).
        points: Reference points, shape (nnode, ncandidate, 2).
        thresholds: Thresholds in steps, shape (nnode, ncandidate).
        most: Samples of a node that are looked at.
        min_leaf: Fewest samples on either side.
        gains: Out: fall of the variance per sample, -1 for a useless split, shape (nnode,
            ncandidate).
    """
    wp.launch(
        _judge_candidates,
        dim=gains.shape,
        inputs=[values, targets, order, starts, points, thresholds, most, min_leaf],
        outputs=[gains],
        device=gains.device,
    )


def route_samples(
    values: wp.array,
    order: wp.array,
    nodes: wp.array,
    points: wp.array,
    thresholds: wp.array,
    *,
    goes_right: wp.array,
) -> None:
    """Which samples go right.

    Args:
        values: Depths at the reference points in integer steps, shape (npoint, nsample) int16.
        order: Samples sorted by node, shape (norder,).
        nodes: Node of each entry of `order`, shape (norder,).
        points: Reference points of each node, shape (nnode, 2).
        thresholds: Threshold of each node in steps, shape (nnode,).
        goes_right: Out: 1 or 0, shape (norder,).
    """
    wp.launch(
        _route_samples,
        dim=goes_right.shape,
        inputs=[values, order, nodes, points, thresholds],
        outputs=[goes_right],
        device=goes_right.device,
    )
