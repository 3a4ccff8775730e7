"""Kernels that score grasps, against the same measures in float64 NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from handtrack.device import resolve_device
from handtrack.grasp.skin_points import SkinPoints
from handtrack.grasp.taxonomy import grip_pads
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE
from handtrack.kernels.grasp_score import measure_overlaps, score_contacts
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
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


def test_overlap_is_that_of_the_deepest_point_whatever_balls_are_passed_over(
    device: str, field: DistanceField, rng: np.random.Generator
) -> None:
    where, hand = resolve_device(device), shaped_hand("right", 2)
    skin = SkinPoints.of(hand, 200)
    rotations, origins = bone_frames(hand, hands_about_an_object(hand, rng, 60))
    table = (0.0, 0.6, 0.8, -0.13)
    depths = wp.full(60, np.inf, dtype=float, device=where)
    measure_overlaps(
        put(skin.group_bones, int, where), put(skin.group_starts, int, where),
        put(skin.group_centres, wp.vec3, where), put(skin.group_radii, float, where),
        put(skin.points.offsets, wp.vec3, where), field.upload(where), table,
        *frames_on(where, rotations, origins), depths=depths,
    )  # fmt: skip
    bones, offsets = skin.points.bones, skin.points.offsets
    points = np.einsum("npij,pj->npi", rotations[:, bones], offsets) + origins[:, bones]
    heights = points @ table[:3] - table[3]
    expected = np.maximum(-np.minimum(field.distance(points), heights).min(1), 0.0)
    assert 0.1 < (expected > 0.002).mean() < 0.95  # some are clear, some are not
    np.testing.assert_allclose(depths.numpy(), expected, atol=2e-6)


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
        scores.append([np.abs(away).sum(), np.linalg.norm(nearest.mean(0)), angles, facing])
    return surfaces, np.array(scores)


def test_contacts_of_several_grip_modes_at_once(
    device: str, field: DistanceField, rng: np.random.Generator
) -> None:
    where, hand = resolve_device(device), shaped_hand("right", 2)
    pads = [grip_pads(hand, name) for name in ("palmar_pinch", "prismatic_4_finger")]
    nframe, count = 3, 24
    rotations, origins = bone_frames(hand, hands_about_an_object(hand, rng, count * nframe))
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
        "scores": wp.full((count, 4), np.inf, dtype=float, device=where),
    }
    score_contacts(
        put(bones, int, where), put(points, wp.vec3, where), put(normals, wp.vec3, where),
        put(pairs, int, where), field.upload(where), put(grips, int, where),
        *frames_on(where, rotations, origins), nframe=nframe, cone=CONE, **found,
    )  # fmt: skip
    last = np.arange(nframe - 1, count * nframe, nframe)
    surfaces, scores = contact_oracle(pads, field, grips, rotations[last], origins[last])
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
