"""Random restarts: within limits, repeatable, and not on every frame of a badly fitting hand."""

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking import model_based
from handtrack.tracking.model_based import ModelBasedConfig, TrackerModelBased
from handtrack.tracking.rescue import restart_poses, turned_over
from handtrack.transforms import pose_difference, quat_to_matrix

CAMERA = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0)


@pytest.fixture(scope="module")
def takes():
    motion = Motion.load("recorded_hand_motion")
    return motion.to_poses()[:30]


@pytest.fixture
def tries(monkeypatch):
    """Frames on which restarts were drawn, one entry each."""
    calls = []

    def counted(*arguments):
        calls.append(1)
        return restart_poses(*arguments)

    monkeypatch.setattr(model_based, "restart_poses", counted)
    return calls


def follow(hand, worn, poses):
    tracker = TrackerModelBased(hand, CAMERA, device="cpu")
    tracker.start(poses[0])
    return [tracker.step(image) for image in DepthRenderer(worn, CAMERA).render(poses)]


def test_restarts_stay_within_limits_and_repeat(takes):
    hand = HandModel.load().shaped()
    first = restart_poses(hand, takes[0], 64, np.random.default_rng(3))
    again = restart_poses(hand, takes[0], 64, np.random.default_rng(3))
    assert first.shape == (64, 28)
    np.testing.assert_array_equal(first, again)
    assert (first[:, 7:] >= hand.limits[:, 0]).all() and (first[:, 7:] <= hand.limits[:, 1]).all()
    np.testing.assert_allclose(np.linalg.norm(first[:, 3:7], axis=1), 1.0, atol=1e-9)
    assert np.abs(first[:, :3] - takes[0, :3]).max() < 0.08


def test_hands_are_turned_over_about_their_middle_with_the_same_angles(takes):
    hand, poses = HandModel.load().shaped(), np.repeat(takes[:1], 400, axis=0)
    turned = turned_over(hand, poses, np.random.default_rng(5))
    np.testing.assert_array_equal(turned, turned_over(hand, poses, np.random.default_rng(5)))
    np.testing.assert_array_equal(turned[:, 7:], poses[:, 7:])
    middle = keypoints(hand, turned).mean(axis=1) - keypoints(hand, poses).mean(axis=1)
    assert np.abs(middle).max() < 1e-9
    angles = np.linalg.norm([pose_difference(one, poses[0])[3:6] for one in turned], axis=1)
    assert np.median(angles) > 1.0
    # Palm for back, fingers still pointing the way they did; and fingers where the wrist was.
    R = quat_to_matrix(turned[:, 3:7])
    along = R[:, :, 0] @ quat_to_matrix(poses[0, 3:7])[:, 0]
    normal = R[:, :, 1] @ quat_to_matrix(poses[0, 3:7])[:, 1]
    assert 0.25 < ((along > 0.7) & (normal < -0.7)).mean() < 0.5
    assert 0.05 < ((along < -0.7) & (normal > 0.7)).mean() < 0.3


def test_a_wrong_shape_does_not_cost_restarts_on_every_frame(takes, tries):
    model = HandModel.load()
    worn = model.shaped(HandShape(scale=0.72))
    found = follow(model.shaped(), worn, takes)
    errors = np.array([estimate.depth_error for estimate in found])
    assert np.median(errors) > ModelBasedConfig().rescue_error, "the case must be a hard one"
    assert 1 <= len(tries) <= len(takes) // 2


def test_restarts_explain_the_image_better_than_going_on(takes, tries):
    hand = HandModel.load().shaped()
    fist = np.tile(takes[0], (12, 1))
    fist[:, [12, 14, 16, 18, 20, 22, 24, 26]] = 1.4
    start = takes[0].copy()
    # Straight fingers, and the palm slid onto the forearm's place.
    start[7:] = 0.0
    start[:3] -= 0.04 * quat_to_matrix(start[3:7])[:, 0]
    images = DepthRenderer(hand, CAMERA).render(fist)
    last = {}
    for rows in (0, 16):
        config = ModelBasedConfig(rescue_rows=rows)
        tracker = TrackerModelBased(hand, CAMERA, config=config, device="cpu")
        tracker.start(start)
        last[rows] = [tracker.step(image) for image in images][-1].depth_error
    assert tries
    assert last[16] < 0.8 * last[0]


@pytest.mark.parametrize(
    "change", [{"rescue_jump": 0.9}, {"rescue_period": 0}, {"rescue_rows": -1}]
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(InputError, match="rescue"):
        ModelBasedConfig(**change)
