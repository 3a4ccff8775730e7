"""Hybrid tracking: starts by itself, recovers, and says when there is no hand."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import TIME_OF_FLIGHT
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.hybrid import HybridConfig
from handtrack.tracking.result import TrackState
from handtrack.tracking.tracker import AUTOMATIC, TRACKERS, HandTracker
from oracles.scenes import hand_model, shaped_hand

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)

FRAMES = (470, 490)
"""An open hand that turns."""


def sequence(side: str = "right", seed: int = 3) -> list[DepthFrame]:
    motion = Motion.load("recorded_hand_motion").take(*FRAMES)
    hand = shaped_hand(side, seed)
    return list(synthesize_sequence(motion, hand, CAMERA, TIME_OF_FLIGHT, device="cpu"))


def shape(seed: int = 3):
    return hand_model().sample_shape(np.random.default_rng(seed))


def error_mm(keypoints: np.ndarray, frame: DepthFrame) -> float:
    assert frame.truth is not None and frame.truth.keypoints is not None
    return float(1e3 * np.linalg.norm(keypoints - frame.truth.keypoints, axis=1).mean())


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    return sequence()


@pytest.fixture(scope="module")
def tracker() -> HandTracker:
    return HandTracker(CAMERA, shape=shape(), device="cpu")


def test_it_starts_without_being_told_anything(tracker, frames) -> None:
    tracker.reset()
    results = [tracker.track(frame.depth) for frame in frames]
    assert all(result.state is TrackState.TRACKING for result in results)
    late = [error_mm(r.keypoints, f) for r, f in zip(results[5:], frames[5:], strict=True)]
    assert np.mean(late) < 10.0


def test_a_left_hand_is_found_too() -> None:
    frames = sequence("left")
    tracker = HandTracker(CAMERA, side="left", shape=shape(), device="cpu")
    results = [tracker.track(frame.depth) for frame in frames[:10]]
    assert error_mm(results[-1].keypoints, frames[9]) < 15.0


def test_it_comes_back_from_a_pose_that_is_nonsense(tracker, frames) -> None:
    assert frames[0].truth is not None and frames[0].truth.pose is not None
    wrong = frames[0].truth.pose.copy()
    wrong[3:7] = wrong[[4, 3, 6, 5]] * [-1, 1, -1, 1]  # turned round
    wrong[:3] += 0.05
    tracker.reset(wrong)
    results = [tracker.track(frame.depth) for frame in frames[:6]]
    assert error_mm(results[-1].keypoints, frames[5]) < 20.0


def test_an_empty_image_is_no_hand_and_a_lost_hand_is_forgotten(tracker, frames) -> None:
    empty = np.zeros(CAMERA.shape, np.float32)
    tracker.reset()
    assert tracker.track(empty).state is TrackState.NO_HAND
    assert tracker.track(frames[0].depth).state is TrackState.TRACKING
    states = [tracker.track(empty).state for _ in range(12)]
    assert states[0] is TrackState.LOST and states[-1] is TrackState.NO_HAND
    assert tracker.track(frames[1].depth).state is TrackState.RECOVERED


def test_the_same_frames_give_the_same_poses(tracker, frames) -> None:
    runs = []
    for _ in range(2):
        tracker.reset()
        runs.append(np.stack([tracker.track(frame.depth).pose for frame in frames[:5]]))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_the_size_of_an_unknown_hand_is_found(frames) -> None:
    large = hand_model().shaped().scaled(1.12)
    motion = Motion.load("recorded_hand_motion").take(*FRAMES)
    shown = list(synthesize_sequence(motion, large, CAMERA, TIME_OF_FLIGHT, device="cpu"))
    tracker = HandTracker(CAMERA, device="cpu")
    for frame in shown:
        tracker.track(frame.depth)
    assert tracker.size == pytest.approx(1.12, abs=0.06)
    tracker.track_batch([np.zeros(CAMERA.shape, np.float32)])
    assert tracker.size == 1.0, "a batch leaves nothing behind"
    for frame in shown:
        tracker.track(frame.depth)
    assert tracker.size != 1.0
    tracker.reset()
    assert tracker.size == 1.0


def test_a_given_shape_keeps_its_size(tracker, frames) -> None:
    tracker.reset()
    for frame in frames[:5]:
        tracker.track(frame.depth)
    assert tracker.size == 1.0


def test_frames_of_a_batch_do_not_know_each_other(tracker, frames) -> None:
    depths = [frames[0].depth, np.zeros(CAMERA.shape, np.float32), frames[10].depth]
    results = tracker.track_batch(depths)
    assert [r.state for r in results] == [
        TrackState.TRACKING, TrackState.NO_HAND, TrackState.TRACKING
    ]  # fmt: skip
    assert results[1].problem
    assert error_mm(results[0].keypoints, frames[0]) < 30.0
    assert error_mm(results[2].keypoints, frames[10]) < 30.0


def test_a_batch_needs_a_tracker_that_starts_by_itself() -> None:
    tracker = HandTracker(CAMERA, device="cpu", tracker="model_based")
    with pytest.raises(InputError, match="hybrid"):
        tracker.track_batch([np.zeros(CAMERA.shape, np.float32)])


@pytest.mark.parametrize(("name", "limit"), [("thesis_hybrid", 15.0), ("discriminative", 45.0)])
def test_other_automatic_trackers_follow_the_hand(name, limit, frames) -> None:
    tracker = HandTracker(CAMERA, shape=shape(), device="cpu", tracker=name)
    assert frames[0].truth is not None
    tracker.reset(frames[0].truth.pose)
    results = [tracker.track(frame.depth) for frame in frames[:6]]
    errors = [error_mm(r.keypoints, f) for r, f in zip(results, frames, strict=False)]
    assert np.median(errors) < limit


def test_the_names_of_automatic_trackers_are_true() -> None:
    small = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    for name in TRACKERS:
        if name != "pso":  # takes long to allocate
            made = HandTracker(small, device="cpu", tracker=name)
            assert made.automatic == (name in AUTOMATIC)


def test_left_and_right_mirror_each_other(frames) -> None:
    right = HandTracker(CAMERA, shape=shape(), device="cpu")
    centred = [f.depth for f in frames[:3]]
    # cx lies half a pixel off the middle of 320 columns, which the mirror image shows.
    mirrored = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=159.0, cy=120.0)
    left = HandTracker(mirrored, side="left", shape=shape(), device="cpu")
    for depth in centred:
        a = right.track(depth)
        b = left.track(np.ascontiguousarray(depth[:, ::-1]))
    gap = np.linalg.norm(a.keypoints * np.array([-1.0, 1.0, 1.0]) - b.keypoints, axis=1).mean()
    assert gap < 0.01
    assert np.isfinite(mirror_pose(a.pose)).all()


@pytest.mark.parametrize(
    "change",
    [
        {"velocity": 3.0}, {"restarts": -1}, {"finalists": 0}, {"doubt_jump": 0.5}, {"gain": 0.0},
        {"lost_error": 1.0}, {"presence_weight": -1.0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(change) -> None:
    with pytest.raises(InputError):
        HybridConfig(**change)
