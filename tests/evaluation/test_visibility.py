"""Which keypoints a camera sees: in front, behind other fingers, out of the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from handtrack.evaluation.visibility import FLESH, visible_keypoints
from handtrack.hand.kinematics import keypoints
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import matrix_to_quat
from oracles.scenes import PALM_TO_CAMERA, SMALL_CAMERA, seen_poses, shaped_hand


def flat(turn: np.ndarray) -> np.ndarray:
    """The straight hand 0.45 m away, its palm turned so, shape (28,)."""
    pose = np.zeros(28)
    pose[2], pose[3:7] = 0.45, matrix_to_quat(turn)
    pose[:3] -= keypoints(shaped_hand(), pose).mean(0) - [0.0, 0.0, 0.45]
    return pose


def test_an_open_hand_is_seen_whole_and_from_the_side_one_finger_hides_the_others() -> None:
    # Fingers up, the thumb's side away from the camera: the little finger is in front.
    edge_on = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = np.stack([flat(PALM_TO_CAMERA), flat(edge_on)])
    seen = visible_keypoints(shaped_hand(), SMALL_CAMERA, poses, device="cpu")
    assert seen.shape == (2, 21) and seen[0].all()
    assert seen[1, [17, 18]].all() and not seen[1, [5, 6]].any()


def test_what_is_hidden_lies_behind_the_rendered_surface(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    poses = seen_poses(hand, rng, 20, turn=1.5, bend=1.0)
    seen = visible_keypoints(hand, SMALL_CAMERA, poses, device="cpu")
    images = DepthRenderer(hand, SMALL_CAMERA, device="cpu").render(poses)
    assert 0.5 < seen.mean() < 0.98
    for image, points, told in zip(images, keypoints(hand, poses), seen, strict=True):
        for point, visible in zip(points, told, strict=True):
            u, v = np.rint(SMALL_CAMERA.project(point)).astype(int)
            z = float(image[v, u])
            # Where the ray meets the surface.
            before = np.linalg.norm(point - point * z / point[2]) if 0 < z < point[2] else 0.0
            assert visible == (before <= FLESH)


def test_out_of_the_image_is_hidden(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    poses = np.stack([flat(PALM_TO_CAMERA)] * 3)
    poses[1, 0] += 0.24
    poses[2, 2] = -0.45
    seen = visible_keypoints(hand, SMALL_CAMERA, poses, device="cpu")
    pixels = SMALL_CAMERA.project(keypoints(hand, poses[1]))
    outside = pixels[:, 0] > SMALL_CAMERA.width - 0.5
    assert 0 < outside.sum() < 21
    np.testing.assert_array_equal(seen[1], ~outside)
    assert not seen[2].any()


def test_the_mirrored_hand_shows_the_same_keypoints(rng: np.random.Generator) -> None:
    poses = seen_poses(shaped_hand(), rng, 12, turn=1.0, bend=1.0)
    # Off by a pixel at silhouettes, so the cameras' axes are set to make the mirror image exact.
    camera = replace(SMALL_CAMERA, cx=(SMALL_CAMERA.width - 1) / 2)
    right = visible_keypoints(shaped_hand(), camera, poses, device="cpu")
    left = visible_keypoints(shaped_hand("left"), camera, mirror_pose(poses), device="cpu")
    assert (right == left).mean() > 0.99
