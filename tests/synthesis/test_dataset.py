"""Training data: repeatable sample by sample, labels that fit, varied, bounded in memory."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.collision import HandSpheres
from handtrack.synthesis.dataset import DATASETS, DatasetConfig, SyntheticDataset
from handtrack.synthesis.scenery import (
    MOST_HIDDEN,
    add_body,
    add_occluder,
    box_depth,
    camera_rays,
    ellipsoid_depth,
    nearest,
    plane_depth,
)

CAMERA = Camera(width=80, height=60, fx=60.0, fy=60.0, cx=39.5, cy=29.5)
CONFIG = DatasetConfig(subjects=3, poses=20, viewpoints=4, camera=CAMERA, seed=5)
CLEAN = replace(CONFIG, noises=("none",), occluder_share=0.0, body_share=0.0)


@pytest.fixture(scope="module")
def dataset() -> SyntheticDataset:
    return SyntheticDataset(CONFIG, device="cpu")


@pytest.fixture(scope="module")
def clean() -> SyntheticDataset:
    return SyntheticDataset(CLEAN, device="cpu")


def test_the_paper_preset_is_the_papers() -> None:
    assert len(DATASETS["paper"]) == 320_000 and len(DATASETS["small"]) == 1000


def test_a_sample_depends_on_seed_and_number_alone(dataset: SyntheticDataset) -> None:
    some = [3, 200, 77, 78, 239, 3]
    together = dataset.render(some)
    other = SyntheticDataset(CONFIG, device="cpu", batch=3)
    in_order = list(other.batches(70, 90, size=7))
    assert [len(b) for b in in_order] == [7, 7, 6]
    alone = [other.render([k]) for k in some]
    for name in ("depth", "poses", "keypoints", "named_pose", "noise", "hidden", "body"):
        values = getattr(together, name)
        for row, single in enumerate(alone):
            np.testing.assert_array_equal(values[row], getattr(single, name)[0], err_msg=name)
        streamed = np.concatenate([getattr(b, name) for b in in_order])
        np.testing.assert_array_equal(values[2:4], streamed[7:9], err_msg=name)
    changed = SyntheticDataset(replace(CONFIG, seed=6), device="cpu").render(some)
    assert not np.allclose(changed.poses, together.poses)


def test_labels_fit_the_images(clean: SyntheticDataset) -> None:
    batch = clean.render(range(0, len(clean), 5))
    model, near, seen = HandModel.load(), 0, 0
    for row in range(len(batch)):
        hand = model.shaped(clean.shape(int(batch.subject[row])))
        points = keypoints(hand, batch.poses[row])
        np.testing.assert_allclose(points, batch.keypoints[row], atol=1e-6)
        pixels = CAMERA.project(points)
        assert (pixels > -0.5).all() and (pixels < [79.5, 59.5]).all()
        u, v = np.rint(pixels).astype(int).T
        depth = batch.depth[row][v, u]
        # Skin lies before the keypoints inside it, or the arm or another finger does.
        near += int(((depth > 0) & (depth < points[:, 2] + 0.003)).sum())
        seen += 21
    assert near / seen > 0.9


def test_angles_keep_to_limits_and_fingers_apart(dataset: SyntheticDataset) -> None:
    batch = dataset.render(range(0, len(dataset), CONFIG.viewpoints))
    limits = HandModel.load().limits
    angles = batch.poses[:, 7:]
    assert ((angles >= limits[:, 0] - 1e-9) & (angles <= limits[:, 1] + 1e-9)).all()
    depth = np.array([
        HandSpheres.of(HandModel.load().shaped(dataset.shape(int(s)))).penetration(a)
        for s, a in zip(batch.subject[::3], angles[::3], strict=True)
    ])  # fmt: skip
    assert (depth <= CONFIG.max_penetration).mean() > 0.9 and depth.max() < 0.012
    named = batch.named_pose >= 0
    assert named.mean() == pytest.approx(CONFIG.library_share)
    # Every subject's named poses are different ones, and perturbed.
    first = batch.named_pose[:12]
    assert len(set(first.tolist())) == 12
    assert np.std(angles, axis=0).min() > 0.05


def test_viewpoints_of_one_pose_differ_and_poses_do_not(dataset: SyntheticDataset) -> None:
    batch = dataset.render(range(8))
    np.testing.assert_array_equal(batch.poses[:4, 7:], np.repeat(batch.poses[:1, 7:], 4, axis=0))
    assert not np.allclose(batch.poses[0, 7:], batch.poses[4, 7:])
    assert len(np.unique(batch.poses[:, 3])) == 8


def test_distractors_come_at_their_rate(dataset: SyntheticDataset) -> None:
    batch = dataset.render(range(len(dataset)))
    assert abs(batch.body.mean() - 0.3) < 0.1 and abs((batch.hidden > 0).mean() - 0.15) < 0.08
    assert batch.hidden.max() <= MOST_HIDDEN
    assert set(batch.noise.tolist()) == {0, 1, 2}
    covered = (batch.depth > 0).mean(axis=(1, 2))
    assert covered[batch.body].mean() > 2 * covered[~batch.body].mean()
    assert batch.depth.dtype == np.float32 and np.isfinite(batch.depth).all()


def test_a_left_hand_is_the_mirror_image(clean: SyntheticDataset) -> None:
    left = SyntheticDataset(replace(CLEAN, side="left"), device="cpu").render(range(6))
    hand = HandModel.load().shaped(clean.shape(0), side="left")
    np.testing.assert_allclose(keypoints(hand, left.poses), left.keypoints, atol=1e-6)
    right = clean.render(range(6))
    # The same turn and angles, mirrored; the place in the image is drawn for itself.
    np.testing.assert_allclose(mirror_pose(right.poses)[:, 3:], left.poses[:, 3:], atol=1e-9)
    assert ((left.depth > 0).sum((1, 2)) > 20).all()


def test_memory_does_not_grow_with_the_data(clean: SyntheticDataset) -> None:
    def peak(count: int) -> int:
        tracemalloc.start()
        for _ in clean.batches(0, count, size=8):
            pass
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    clean.render([0])
    assert peak(80) < 1.3 * peak(16)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"subjects": 0}, "subjects is 0"), ({"seed": -1}, "seed is -1"),
        ({"side": "both"}, "side is 'both'"), ({"noises": ()}, "noises is empty"),
        ({"noises": ("fog",)}, "no sensor noise is called 'fog'"),
        ({"body_share": 1.5}, "body_share is 1.5"), ({"perturbation": -0.1}, "perturbation is"),
        ({"distance": (0.9, 0.2)}, "distance is"),
    ],
)  # fmt: skip
def test_bad_settings_are_told(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(CONFIG, **change)


def test_samples_that_are_not_there_are_told(dataset: SyntheticDataset) -> None:
    with pytest.raises(InputError, match="numbers of 0 to 239"):
        dataset.render([240])
    with pytest.raises(InputError, match="range within 0:240"):
        next(dataset.batches(0, 241))


def test_shapes_have_their_depth() -> None:
    rays, turn = camera_rays(CAMERA), np.eye(3)
    centre = np.array([0.0, 0.0, 0.5])
    ball = ellipsoid_depth(rays, centre, turn, np.array([0.1, 0.1, 0.1]))
    box = box_depth(rays, centre, turn, np.array([0.1, 0.05, 0.02]))
    plane = plane_depth(rays, centre, np.array([0.0, 0.6, -0.8]))
    assert ball[29, 39] == pytest.approx(0.4, abs=1e-3) and ball[0, 0] == 0
    points = CAMERA.points(ball)[ball > 0]
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), 0.1, atol=1e-5)
    assert box[29, 39] == pytest.approx(0.48, abs=1e-4)
    edge = CAMERA.points(box)[box > 0]
    assert np.abs(edge[:, 0]).max() == pytest.approx(0.1, abs=0.01)
    np.testing.assert_allclose(
        (CAMERA.points(plane)[plane > 0] - centre) @ [0, 0.6, -0.8], 0, atol=2e-6
    )
    np.testing.assert_array_equal(nearest(ball, plane) > 0, (ball > 0) | (plane > 0))


def test_scenery_is_before_and_behind_the_hand(clean: SyntheticDataset) -> None:
    batch, rays = clean.render(range(0, 240, 8)), camera_rays(CAMERA)
    hid = 0
    for row in range(len(batch)):
        rng = np.random.default_rng(row)
        hand, points = batch.depth[row], batch.keypoints[row].astype(np.float64)
        both, share = add_occluder(hand, rays, points, rng)
        changed = both != hand
        assert (both[changed] < points[:, 2].min()).all() and 0 <= share <= MOST_HIDDEN
        hid += share > 0
        behind = add_body(hand, rays, points, rng)
        u, v = np.rint(CAMERA.project(points)).astype(int).T
        new = (behind != hand)[v, u]
        assert (behind[v, u][new] > points[new, 2]).all()
        assert (behind > 0).sum() > (hand > 0).sum()
    assert hid > 0.8 * len(batch)
