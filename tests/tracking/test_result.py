"""What a result says of its own certainty."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.fitting.uncertainty import keypoint_deviation
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import TIME_OF_FLIGHT
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.tracker import HandTracker
from oracles.scenes import shaped_hand

CAMERA = Camera(width=160, height=120, fx=120.71, fy=120.71, cx=79.5, cy=59.5)


@pytest.fixture(scope="module")
def frames() -> list[DepthFrame]:
    """A hand that moves its fingers."""
    motion = Motion.load("recorded_hand_motion").take(877, 882)
    return list(synthesize_sequence(motion, shaped_hand(), CAMERA, TIME_OF_FLIGHT, device="cpu"))


def start(frames: list[DepthFrame], tracker: str = "model_based") -> HandTracker:
    track = HandTracker(CAMERA, tracker=tracker, device="cpu")
    assert frames[0].truth is not None
    track.reset(frames[0].truth.pose)
    return track


@pytest.mark.parametrize("tracker", ["model_based", "thesis"])
def test_tracked_keypoints_have_a_deviation(frames: list[DepthFrame], tracker: str) -> None:
    track = start(frames, tracker)
    for frame in frames:
        result = track.track(frame.depth)
        assert result.state is TrackState.TRACKING and result.information is not None
        sigma = result.keypoint_std
        assert sigma.shape == (21,) and sigma.dtype == np.float32
        assert (sigma > 0.5e-3).all() and (sigma < 0.1).all()
        assert result.keypoint_std is sigma, "computed once"
        expected = keypoint_deviation(track.hand, result.pose, result.information)
        np.testing.assert_allclose(sigma, expected, rtol=1e-6)


def nothing(depth: NDArray[np.float32]) -> object:
    return np.zeros_like(depth)


def wall(depth: NDArray[np.float32]) -> object:
    return np.full_like(depth, 0.45)


def broken(depth: NDArray[np.float32]) -> object:
    return "no image"


@pytest.mark.parametrize("spoil", [nothing, wall, broken])
def test_a_lost_hand_has_no_deviation_and_the_next_frame_has(
    frames: list[DepthFrame], spoil: Callable[[NDArray[np.float32]], object]
) -> None:
    track = start(frames)
    track.track(frames[0].depth)
    lost = track.track(spoil(frames[1].depth))
    assert lost.state is TrackState.LOST
    assert lost.keypoint_std.shape == (21,) and np.isnan(lost.keypoint_std).all()
    found = track.track(frames[2].depth)
    assert found.state is TrackState.RECOVERED and np.isfinite(found.keypoint_std).all()


def test_no_hand_and_no_information_give_nan(frames: list[DepthFrame]) -> None:
    unstarted = HandTracker(CAMERA, tracker="model_based", device="cpu")
    result = unstarted.track(frames[0].depth)
    assert result.state is TrackState.NO_HAND and np.isnan(result.keypoint_std).all()
    bare = HandResult(
        state=TrackState.TRACKING, side="right", pose=np.eye(1, 28, 3)[0], depth_error=0.001,
        hand=shaped_hand(),
    )  # fmt: skip
    assert np.isnan(bare.keypoint_std).all()


def test_a_noisier_image_is_less_certain(frames: list[DepthFrame]) -> None:
    rng = np.random.default_rng(0)
    sigmas = []
    for noise in (0.0, 0.006, 0.012):
        track = start(frames)
        depth = frames[0].depth.copy()
        depth[depth > 0] += (noise * rng.standard_normal((depth > 0).sum())).astype(np.float32)
        sigmas.append(track.track(depth).keypoint_std.mean())
    assert sigmas[0] < sigmas[1] < sigmas[2]
