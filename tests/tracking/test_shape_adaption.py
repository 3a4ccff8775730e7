"""Shape adaption while tracking: it finds the hand, freezes, and is forgotten by a reset."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.model import ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.subjects import UnseenSubjects
from handtrack.tracking.shape_adaption import AdaptionConfig
from handtrack.tracking.tracker import HandTracker
from oracles.scenes import SMALL_CAMERA, hand_model, seen_poses

Float = NDArray[np.float64]

FRAMES = 70


def take() -> tuple[ShapedHand, Float, NDArray[np.float32]]:
    """A subject's hand that opens and closes while it turns, near the camera."""
    rng = np.random.default_rng(5)
    hand = UnseenSubjects.load().hand(12, hand_model())
    first, second = seen_poses(hand, rng, 2, distance=0.3, turn=0.15, bend=0.1)
    share = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(FRAMES) / 35)
    poses = first + share[:, None] * (second - first)
    poses[:, [10, 14, 18, 22, 26]] += 0.6 * share[:, None]
    poses[:, 7:] = poses[:, 7:].clip(*hand.limits.T)
    poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
    return hand, poses, DepthRenderer(hand, SMALL_CAMERA, device="cpu").render(poses)


def test_the_hand_becomes_the_persons_and_a_reset_forgets_it() -> None:
    truth, poses, depths = take()
    tracker = HandTracker(
        SMALL_CAMERA, tracker="model_based", device="cpu", adapt_shape=True, model=hand_model()
    )
    tracker.reset(poses[0])
    mean = tracker.hand

    def error() -> float:
        return 1e3 * float(np.abs(tracker.hand.bone_lengths - truth.bone_lengths).mean())

    before = error()
    for depth in depths:
        result = tracker.track(depth)
        assert result.state.value == "tracking", result.problem
    assert "shape" in result.timings
    assert before > 3.0 and error() < 0.55 * before
    found = tracker.shape
    assert found.alpha_std is not None and found.scale_std is not None
    np.testing.assert_allclose(
        hand_model().shaped(found).bone_lengths, tracker.hand.bone_lengths, rtol=1e-6
    )
    tracker.reset(poses[0])
    assert tracker.hand is mean and not tracker.shape_frozen
    assert tracker.shape.alpha_std is None
    fresh = HandTracker(SMALL_CAMERA, tracker="model_based", device="cpu", model=hand_model())
    fresh.reset(poses[0])
    np.testing.assert_array_equal(tracker.track(depths[0]).pose, fresh.track(depths[0]).pose)


def test_a_reshaped_tracker_is_like_one_made_with_the_shape() -> None:
    _, poses, depths = take()
    shape = HandShape(alpha=np.array([-1.5, 0.5]), beta=np.array([0.5]))
    options = {"tracker": "model_based", "device": "cpu", "model": hand_model()}
    made = HandTracker(SMALL_CAMERA, shape=shape, **options)
    changed = HandTracker(SMALL_CAMERA, **options)
    changed.reshape(shape)
    for tracker in (made, changed):
        tracker.reset(poses[0])
    for depth in depths[:3]:
        np.testing.assert_allclose(changed.track(depth).pose, made.track(depth).pose, atol=1e-6)


def test_trackers_bound_to_their_hand_say_so() -> None:
    for made in (True, False):
        with pytest.raises(InputError, match="bound to its hand"):
            tracker = HandTracker(
                SMALL_CAMERA, tracker="pso", device="cpu", adapt_shape=made, model=hand_model()
            )
            tracker.reshape(HandShape())


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(InputError, match="least_frames"):
        AdaptionConfig(frames=2, least_frames=3)
    with pytest.raises(InputError, match="sure"):
        AdaptionConfig(sure=0.0)
