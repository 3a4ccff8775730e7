"""Rendered hands against ray casting, and what must not change the picture."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import skin
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.renderer import DepthRenderer
from oracles.raycast import cast_rays
from oracles.scenes import SMALL_CAMERA, seen_poses, shaped_hand

CAMERA = Camera(width=80, height=60, fx=62.0, fy=62.0, cx=39.5, cy=29.5)


@pytest.mark.parametrize("arm", [False, True])
def test_depth_and_triangles_agree_with_ray_casting(
    device: str, rng: np.random.Generator, arm: bool
) -> None:
    hand = shaped_hand(seed=2)
    pose = seen_poses(hand, rng, 1)[0]
    elbow = pose[:3] + np.array([0.08, 0.2, 0.05]) if arm else None
    renderer = DepthRenderer(hand, CAMERA, device=device, batch=1)
    depth, items, vertices, faces = renderer.surface(pose, elbow=elbow)
    np.testing.assert_allclose(vertices[: hand.nvert], skin(hand, pose), atol=1e-6)

    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float), np.ones(v.size))
    true, first = cast_rays(vertices, faces, rays)
    true = np.where(np.isfinite(true), true, 0.0).reshape(depth.shape)
    both = (depth > 0) & (true > 0)
    assert both.sum() > 200
    # Rays along an outline may fall on either side of it in single precision.
    assert ((depth > 0) != (true > 0)).sum() <= 2
    assert np.abs(depth - true)[both].max() < 1e-4
    hits = [items.ravel()[k] in first[k] for k in np.flatnonzero(both.ravel())]
    assert np.mean(hits) > 0.98
    assert (items[depth == 0] == -1).all()


def test_the_forearm_takes_the_place_of_the_stub(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)
    renderer = DepthRenderer(hand, SMALL_CAMERA, device="cpu")
    bare = renderer.render(pose)[0]
    elbow = pose[:, :3] + [0.0, 0.25, 0.0]
    sleeved = renderer.render(pose, elbows=elbow)[0]
    assert (sleeved > 0).sum() > 1.3 * (bare > 0).sum()
    assert (sleeved[-1] > 0).any() and not (bare[-1] > 0).any(), "the arm reaches the border"
    # Drawing without it afterwards leaves nothing behind.
    np.testing.assert_array_equal(renderer.render(pose)[0], bare)


def test_a_batch_draws_what_single_calls_draw(device: str, rng: np.random.Generator) -> None:
    hand = shaped_hand()
    poses = seen_poses(hand, rng, 7)
    elbows = poses[:, :3] + [0.0, 0.25, 0.05]
    alone = DepthRenderer(hand, SMALL_CAMERA, device=device, batch=1)
    for arms in (None, elbows):
        together = DepthRenderer(hand, SMALL_CAMERA, device=device, batch=3).render(
            poses, elbows=arms
        )
        assert together.shape == (7, *SMALL_CAMERA.shape) and together.dtype == np.float32
        for k, pose in enumerate(poses):
            one = alone.render(pose[None], elbows=None if arms is None else arms[k : k + 1])
            np.testing.assert_array_equal(one[0], together[k])


def test_a_left_hand_is_the_mirror_image(rng: np.random.Generator) -> None:
    camera = Camera(width=160, height=120, fx=121.0, fy=121.0, cx=79.5, cy=59.5)
    right = shaped_hand(seed=4)
    left = shaped_hand("left", seed=4)
    poses = seen_poses(right, rng, 3)
    pictures = DepthRenderer(right, camera, device="cpu").render(poses)
    mirrored = DepthRenderer(left, camera, device="cpu").render(mirror_pose(poses))[:, :, ::-1]
    differ = (pictures > 0) != (mirrored > 0)
    assert differ.sum() <= 0.002 * (pictures > 0).sum()
    both = (pictures > 0) & (mirrored > 0)
    assert np.percentile(np.abs(pictures - mirrored)[both], 99.5) < 1e-4


def test_aiming_is_like_a_new_renderer(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)
    near = Camera(width=160, height=120, fx=200.0, fy=200.0, cx=90.0, cy=50.0)
    renderer = DepthRenderer(hand, SMALL_CAMERA, device="cpu", batch=1)
    renderer.aim(near)
    fresh = DepthRenderer(hand, near, device="cpu", batch=1)
    np.testing.assert_array_equal(renderer.render(pose), fresh.render(pose))
    with pytest.raises(InputError, match="made for 160x120"):
        renderer.aim(CAMERA)


def test_a_hand_behind_the_camera_or_out_of_view_leaves_an_empty_image() -> None:
    hand = shaped_hand()
    pose = np.zeros((2, 28))
    pose[:, 3] = 1.0
    pose[0, 2], pose[1, :3] = -0.5, [5.0, 0.0, 0.5]
    images = DepthRenderer(hand, SMALL_CAMERA, device="cpu").render(pose)
    assert not images.any()
