"""Following a hand from its first pose: both sides, both trackers, alone and repeatedly."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import NONE, TIME_OF_FLIGHT, SensorNoise
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.model_based import ModelBasedConfig
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.tracker import HandTracker
from oracles.scenes import hand_model, shaped_hand

CAMERA = Camera(width=160, height=120, fx=120.71, fy=120.71, cx=79.5, cy=59.5)


def sequence(
    side: str = "right", seed: int = 0, count: int = 40, noise: SensorNoise = TIME_OF_FLIGHT,
    **options: object,
) -> list[DepthFrame]:  # fmt: skip
    """Frames of a hand that moves its fingers and turns over."""
    motion = Motion.load("recorded_hand_motion").take(877, 877 + count)
    hand = shaped_hand(side, seed)
    return list(synthesize_sequence(motion, hand, CAMERA, noise, device="cpu", **options))  # type: ignore[arg-type]


def follow(track: HandTracker, frames: Iterable[DepthFrame]) -> list[HandResult]:
    """Results over frames, first pose given."""
    results = []
    for frame in frames:
        if not results:
            assert frame.truth is not None
            track.reset(frame.truth.pose)
        results.append(track.track(frame.depth))
    return results


def errors_mm(results: list[HandResult], frames: list[DepthFrame]) -> np.ndarray:
    """Mean keypoint error of each frame [mm]."""
    truth = np.stack([frame.truth.keypoints for frame in frames])  # type: ignore[union-attr]
    found = np.stack([result.keypoints for result in results])
    return 1e3 * np.linalg.norm(found - truth, axis=-1).mean(1)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_moving_hand_is_followed(device: str, side: str) -> None:
    frames = sequence(side, seed=3)
    shape = hand_model().sample_shape(np.random.default_rng(3))
    track = HandTracker(CAMERA, side=side, shape=shape, device=device, tracker="model_based")
    results = follow(track, frames)
    assert all(result.state is TrackState.TRACKING for result in results)
    errors = errors_mm(results, frames)
    assert errors.mean() < 8.0 and errors.max() < 20.0
    moved = np.linalg.norm(frames[-1].truth.keypoints - frames[0].truth.keypoints, axis=1)  # type: ignore[union-attr]
    assert 1e3 * moved.mean() > 2 * errors.max(), "standing still would not do"


def test_a_left_hand_is_followed_as_its_mirror_image() -> None:
    # The camera's axis is in the middle of the image, so the mirrored image is one of its own.
    frames = sequence(count=12, noise=NONE)
    # Random restarts are drawn for either hand alike, not for its mirror image.
    config = ModelBasedConfig(rescue_rows=0)
    right = follow(HandTracker(CAMERA, config=config, device="cpu", tracker="model_based"), frames)
    track = HandTracker(CAMERA, side="left", config=config, device="cpu", tracker="model_based")
    assert frames[0].truth is not None
    track.reset(mirror_pose(frames[0].truth.pose))  # type: ignore[arg-type]
    off = []
    for frame, result in zip(frames, right, strict=True):
        mirrored = track.track(np.ascontiguousarray(frame.depth[:, ::-1]))
        assert mirrored.side == "left"
        expected = result.keypoints * [-1, 1, 1]
        # The grid of sampled points begins at the left border for both.
        off.append(1e3 * np.linalg.norm(mirrored.keypoints - expected, axis=1).mean())
    assert max(off) < 4.0


def test_the_tracker_of_the_thesis_runs() -> None:
    frames = sequence(count=15)
    results = follow(HandTracker(CAMERA, tracker="thesis", device="cpu"), frames)
    errors = errors_mm(results, frames)
    assert np.isfinite(errors).all() and errors[:5].mean() < 25.0
    assert results[0].state is TrackState.TRACKING


def test_the_same_frames_give_the_same_results() -> None:
    frames = sequence(count=6)
    track = HandTracker(CAMERA, device="cpu", tracker="model_based")
    first, second = follow(track, frames), follow(track, frames)
    other = follow(HandTracker(CAMERA, device="cpu", tracker="model_based", graph=False), frames)
    for a, b, c in zip(first, second, other, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_allclose(a.keypoints, c.keypoints, atol=1e-6)


def test_a_result_is_kept_while_tracking_goes_on() -> None:
    frames = sequence(count=4)
    track = HandTracker(CAMERA, device="cpu", tracker="model_based")
    assert frames[0].truth is not None
    start = np.array(frames[0].truth.pose)
    track.reset(start)
    first = track.track(frames[0].depth)
    pose, points = first.pose.copy(), first.keypoints.copy()
    start[:] = 7.0
    for frame in frames[1:]:
        track.track(frame.depth)
    np.testing.assert_array_equal(first.pose, pose)
    np.testing.assert_array_equal(first.keypoints, points)
    assert first.vertices.shape == (track.hand.nvert, 3) and first.vertices.dtype == np.float32
    assert first.keypoints.dtype == np.float32
    assert {"check", "fit", "total"} <= set(first.timings)
    assert first.timings["total"] >= first.timings["fit"] > 0


def test_another_shape_than_the_hand_s_shows_in_the_depth_error() -> None:
    frames = sequence(seed=3, count=8)
    shape = hand_model().sample_shape(np.random.default_rng(3))
    own = follow(HandTracker(CAMERA, shape=shape, device="cpu", tracker="model_based"), frames)
    wrong = hand_model().sample_shape(np.random.default_rng(3), deviation=-2.0)
    other = follow(HandTracker(CAMERA, shape=wrong, device="cpu", tracker="model_based"), frames)
    assert np.median([r.depth_error for r in own]) < np.median([r.depth_error for r in other])
