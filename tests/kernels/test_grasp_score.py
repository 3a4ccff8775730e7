"""Kernels that score grasps, against the same measures in float64 NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from handtrack.device import resolve_device
from handtrack.grasp.skin_points import SkinPoints
from handtrack.grasp.taxonomy import grip_pads
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE
from handtrack.kernels.grasp_score import (
    GraspTask,
    measure_overlaps,
    score_contacts,
    weigh_contacts,
    weigh_overlaps,
)
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
from oracles.balance import imbalance
from oracles.device_arrays import download, poisoned, upload
from oracles.scenes import shaped_hand

CONE = 0.4


@pytest.fixture(scope="module")
def field() -> DistanceField:
    return DistanceField.of(load_object("apple"), device="cpu")


def hands_about_an_object(hand: ShapedHand, rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses whose palm is a few centimetres from the origin, shape (count, 28)."""
    poses = np.zeros((count, 28))
    turn = rotvec_to_matrix(rng.normal(size=(count, 3)))
    poses[:, 3:7] = matrix_to_quat(turn)
    middle = np.array([0.09, 0.07, 0.0]) + 0.03 * rng.normal(size=(count, 3))
    poses[:, :3] = -np.einsum("nij,nj->ni", turn, middle)
    low, high = hand.limits.T
    poses[:, 7:] = rng.uniform(low, high, (count, 21))
    return poses


def put(values: np.ndarray, dtype: type, device: wp.Device) -> wp.array:
    kind = np.int32 if dtype is int else np.float32
    return wp.array(np.asarray(values).astype(kind), dtype=dtype, device=device)


def frames_on(device: wp.Device, rotations: np.ndarray, origins: np.ndarray) -> tuple:
    return put(rotations, wp.mat33, device), put(origins, wp.vec3, device)


def make_task(device: wp.Device, field: DistanceField | None = None, **values: Any) -> tuple:
    """An array of one task, and what it points to."""
    task: Any = GraspTask()
    if field is not None:
        task.grid = field.upload(device)
    for name, value in values.items():
        setattr(task, name, value)
    return wp.array([task], dtype=GraspTask, device=device), task


def test_overlap_is_that_of_the_deepest_point_whatever_balls_are_passed_over(
    device: str, field: DistanceField, rng: np.random.Generator
) -> None:
    where, hand = resolve_device(device), shaped_hand("right", 2)
    skin = SkinPoints.of(hand, 200)
    rotations, origins = bone_frames(hand, hands_about_an_object(hand, rng, 60))
    table = (0.0, 0.6, 0.8, -0.13)
    depths = poisoned(60, device)
    tasks, _kept = make_task(where, field, table=wp.vec4(*table))
    row_hand, limits = np.zeros(60, int), np.full(20, np.inf)
    row_hand[7], limits[[3, 4]] = -1, (0.004, -1.0)
    measure_overlaps(
        put(skin.group_bones, int, where), put(skin.group_starts, int, where),
        put(skin.group_centres, wp.vec3, where), put(skin.group_radii, float, where),
        put(skin.points.offsets, wp.vec3, where), tasks, upload(limits, device),
        upload(row_hand, device),
        *frames_on(where, rotations, origins), depths=depths,
    )  # fmt: skip
    bones, offsets = skin.points.bones, skin.points.offsets
    points = np.einsum("npij,pj->npi", rotations[:, bones], offsets) + origins[:, bones]
    heights = points @ table[:3] - table[3]
    expected = np.maximum(-np.minimum(field.distance(points), heights).min(1), 0.0)
    assert 0.1 < (expected > 0.002).mean() < 0.95  # some are clear, some are not
    beyond = expected > np.tile(limits, 3)
    assert 3 < beyond.sum() < 6
    expected[beyond] = np.inf
    expected[7] = np.nan  # left out
    np.testing.assert_allclose(download(depths), expected, atol=2e-6)


def contact_oracle(
    pads: list, field: DistanceField, grips: np.ndarray, rotations: np.ndarray, origins: np.ndarray
) -> tuple[list, np.ndarray]:
    """Nearest points, and sum of distances, centroid, angles and facing of every particle."""
    surfaces, scores = [], []
    for k, grip in enumerate(grips):
        pad = pads[grip]
        R = rotations[k, pad.bones]
        points = np.einsum("cij,cj->ci", R, pad.points) + origins[k, pad.bones]
        away, normals = field.distance(points), field.normal(points)
        nearest = points - away[:, None] * normals
        angles = 0.0
        for a, b in pad.pairs:
            line = (nearest[b] - nearest[a]) / np.linalg.norm(nearest[b] - nearest[a])
            cosines = np.clip([-line @ normals[a], line @ normals[b]], -1, 1)
            angles += np.maximum(np.arccos(cosines) - CONE, 0.0).sum()
        press = np.einsum("cij,cj->ci", R, pad.normals)
        facing = np.maximum(0.5 + (press * normals).sum(1), 0.0).sum()
        surfaces.append(nearest)
        scores.append([
            np.abs(away).sum(), np.linalg.norm(nearest.mean(0)), angles, facing,
            imbalance(nearest, normals),
        ])  # fmt: skip
    return surfaces, np.array(scores)


def test_contacts_of_several_grip_modes_at_once(
    device: str, field: DistanceField, rng: np.random.Generator
) -> None:
    where, hand = resolve_device(device), shaped_hand("right", 2)
    pads = [grip_pads(hand, name) for name in ("palmar_pinch", "prismatic_4_finger")]
    count = 24
    rotations, origins = bone_frames(hand, hands_about_an_object(hand, rng, count))
    grips = rng.integers(0, 2, count)
    bones, pairs = np.full((2, 5), -1), np.full((2, 4, 2), -1)
    points, normals = np.zeros((2, 2, 5, 3))
    for k, pad in enumerate(pads):
        n = len(pad.bones)
        bones[k, :n], points[k, :n], normals[k, :n] = pad.bones, pad.points, pad.normals
        pairs[k, : len(pad.pairs)] = pad.pairs
    found = {
        "points": wp.full((count, 5), wp.vec3(np.inf), dtype=wp.vec3, device=where),
        "normals": wp.full((count, 5), wp.vec3(np.inf), dtype=wp.vec3, device=where),
        "scores": wp.full((count, 5), np.inf, dtype=float, device=where),
    }
    tasks, _kept = make_task(where, field, cone=CONE)
    score_contacts(
        put(bones, int, where), put(points, wp.vec3, where), put(normals, wp.vec3, where),
        put(pairs, int, where), tasks, put(grips, int, where),
        *frames_on(where, rotations, origins), **found,
    )  # fmt: skip
    surfaces, scores = contact_oracle(pads, field, grips, rotations, origins)
    assert rotations.shape[1] == NBONE
    # Where the distance has a crease, float32 may take the normal of the other side.
    errors = np.abs(found["scores"].numpy() - scores)
    assert np.quantile(errors, 0.9) < 1e-3
    assert np.median(errors, axis=0).max() < 1e-4
    for k, grip in enumerate(grips):
        n = len(pads[grip].bones)
        off = np.linalg.norm(found["points"].numpy()[k, :n] - surfaces[k], axis=1)
        assert np.median(off) < 1e-4
        assert (found["points"].numpy()[k, n:] == 0).all()
        assert (found["normals"].numpy()[k, n:] == 0).all()


def test_balance_is_that_of_the_best_shares_of_all_contacts(
    device: str, field: DistanceField, rng: np.random.Generator
) -> None:
    where, hand = resolve_device(device), shaped_hand("right", 2)
    pad = grip_pads(hand, "medium_wrap")
    count = 200
    rotations, origins = bone_frames(hand, hands_about_an_object(hand, rng, count))
    size = len(pad.bones)
    points, normals = (wp.zeros((count, size), dtype=wp.vec3, device=where) for _ in range(2))
    scores, (tasks, _kept) = poisoned((count, 5), device), make_task(where, field, cone=CONE)
    score_contacts(
        put(pad.bones[None], int, where), put(pad.points[None], wp.vec3, where),
        put(pad.normals[None], wp.vec3, where), put(pad.pairs[None], int, where), tasks,
        upload(np.zeros(count, int), device), *frames_on(where, rotations, origins),
        points=points, normals=normals, scores=scores,
    )  # fmt: skip
    there = (points.numpy().astype(np.float64), normals.numpy().astype(np.float64))
    expected = np.array([imbalance(*contacts) for contacts in zip(*there, strict=True)])
    assert expected.min() < 0.3 and expected.max() > 0.8
    errors = download(scores)[:, 4] - expected
    assert errors.min() > -1e-4  # the oracle's is the least there is
    assert np.median(errors) < 0.005 and errors.max() < 0.05


def test_terms_are_weighed_and_particles_given_up_once_they_are_no_better(device: str) -> None:
    where, nframe = resolve_device(device), 4
    tasks, _kept = make_task(
        where, prior=0.5, collision=8.0, depth=400.0, tolerance=0.002, contact=100.0, facing=3.0,
        centroid=20.0, angle=2.0, balance=0.5,
    )  # fmt: skip
    densities, scores = np.array([-2.0, -4.0, 6.0]), np.array([
        [0.01, 0.02, 0.4, 1.0, 0.4], [0.0, 0.0, 0.0, 0.0, 0.0], [0.03, 0.1, 1.0, 0.0, 0.0],
    ])  # fmt: skip
    terms, limits = poisoned((3, 4), device), poisoned(3, device)
    bounds = upload(np.array([np.inf, 4.0, 4.5]), device)
    weigh_contacts(
        tasks, upload(densities, device), upload(scores, device), bounds, nframe, terms=terms,
        limits=limits,
    )  # fmt: skip
    expected = np.array([[1.0, 0.0, 4.0, 1.4], [2.0, 0.0, 0.0, 0.0], [-3.0, 0.0, 3.0, 4.0]])
    np.testing.assert_allclose(download(terms), expected, rtol=1e-6)

    # The second may cost 2 more than it does; a collision in one frame of four costs 2 and depth.
    np.testing.assert_allclose(download(limits), [np.inf, 0.002, 0.002], rtol=1e-6)

    # From the grasping pose back: only there nothing is said of 2 mm.
    depths = np.array([[0.002, 0.003, 0.0], [0.001, 0.0, 0.0], [0.0, 0.0, 0.0], [0.01, 0.01, 0.0]])
    totals, row_hand = poisoned(3, device), upload(np.zeros(nframe * 3, int), device)
    deep = upload(depths.ravel(), device)
    given = {"terms": terms, "totals": totals, "limits": limits, "row_hand": row_hand}
    weigh_overlaps(tasks, bounds, deep, (0, 1), nframe, **given)
    # (8 + 400 * 0.001) / 4 of the second's grasping pose; 2 + 2.1 is no lower than 4.
    np.testing.assert_allclose(download(totals), [6.4, np.inf, 4.0], rtol=1e-6)
    np.testing.assert_array_equal(
        download(row_hand).reshape(nframe, 3), [[0] * 3] + [[0, -1, 0]] * 3
    )
    weigh_overlaps(tasks, bounds, deep, (1, nframe), nframe, **given)
    np.testing.assert_allclose(download(totals), [11.5, np.inf, 4.0], rtol=1e-6)
    np.testing.assert_allclose(download(terms)[:, 1], [5.1, 2.1, 0.0], rtol=1e-6)
