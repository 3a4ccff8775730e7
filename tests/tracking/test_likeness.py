"""What is measured of a fitted pose beyond its depth error."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.scenery import DepthScene
from handtrack.tracking.likeness import FEATURES, HandLikeness
from oracles.scenes import shaped_hand

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)
FINE = Camera(width=640, height=480, fx=482.84, fy=482.84, cx=320.5, cy=240.5)


def pose(x: float = 0.0, angle: float = 0.4) -> np.ndarray:
    pose = np.zeros(28)
    # Fingers up, palm to the camera.
    pose[:3] = x, 0.08, 0.5
    pose[3:7] = 0.5, -0.5, 0.5, -0.5
    pose[7:] = angle
    return pose


def measured(depth: np.ndarray, pose: np.ndarray, camera: Camera = CAMERA) -> dict[str, float]:
    likeness = HandLikeness(shaped_hand("right", 3), camera, device="cpu")
    return dict(zip(FEATURES, likeness.measure(depth, pose).tolist(), strict=True))


def drawn(pose: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    return DepthRenderer(shaped_hand("right", 3), camera, device="cpu").render(pose)[0]


def test_the_hand_itself_is_like_a_hand() -> None:
    found = measured(drawn(pose()), pose())
    assert found["within 5 mm"] > 0.9
    assert found["relief"] > 0.95 and found["relief correlation, fine"] > 0.9
    assert found["outline"] > 0.95 and found["left over"] < 0.1
    assert found["normals"] > 0.95


def test_a_smooth_body_of_a_hands_size_is_not() -> None:
    fist = pose(angle=1.2)
    middle = keypoints(shaped_hand("right", 3), fist).mean(axis=0)
    scene = DepthScene(CAMERA)
    scene.add_ellipsoid(
        middle + np.array([0.0, 0.0, 0.02]), np.eye(3), np.array([0.045, 0.055, 0.04])
    )
    body, hand = measured(scene.depth, fist), measured(drawn(fist), fist)
    assert body["relief"] < hand["relief"] - 0.1
    assert body["relief correlation, fine"] < hand["relief correlation, fine"] - 0.3


def test_features_do_not_depend_on_the_resolution() -> None:
    coarse = measured(drawn(pose()), pose())
    fine = measured(drawn(pose(), FINE), pose(), FINE)
    for name in ("within 10 mm", "relief", "outline", "area", "reach of the fingers"):
        assert fine[name] == pytest.approx(coarse[name], abs=0.08), name


def test_each_flaw_shows_in_its_feature() -> None:
    depth = drawn(pose())
    good = measured(depth, pose())
    wall = np.where(depth > 0, depth, depth[depth > 0].mean())
    assert measured(wall, pose())["outline"] < good["outline"] - 0.5
    assert measured(wall, pose())["left over"] > good["left over"] + 0.2
    hidden = np.where(depth > 0, depth, 0.0)
    hidden[:110] = np.where(hidden[:110] > 0, 0.3, 0.0)
    assert measured(hidden, pose())["hidden"] > good["hidden"] + 0.2
    gone = depth.copy()
    gone[:100] = 0.0
    assert measured(gone, pose())["background seen through"] > 0.1
    assert measured(gone, pose())["worst finger"] < good["worst finger"]


def test_a_pose_out_of_view_has_no_features() -> None:
    likeness = HandLikeness(shaped_hand("right", 3), CAMERA, device="cpu")
    depth = drawn(pose())
    for away in (pose(x=5.0), np.where(np.arange(28) == 2, -0.5, pose())):
        assert np.isnan(likeness.measure(depth, away)).all()


def test_an_empty_image_is_nothing_like_a_hand() -> None:
    found = measured(np.zeros(CAMERA.shape, np.float32), pose())
    assert found["background seen through"] == 1.0 and found["relief"] == 0.0
