"""Synthesised sequences: labels that fit the image, repeatable noise, both sides."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import NONE, TIME_OF_FLIGHT
from handtrack.synthesis.sequence import (
    CAMERAS,
    FOREARM_LENGTH,
    frames_out_of_view,
    synthesize_sequence,
    worn_by,
)
from oracles.scenes import shaped_hand

CAMERA = Camera(width=160, height=120, fx=120.71, fy=120.71, cx=79.5, cy=59.5)


def motion() -> Motion:
    """Some frames of motion that comes with handtrack."""
    return Motion.load("recorded_hand_motion").take(817, 857)


@pytest.mark.parametrize("side", ["right", "left"])
def test_labels_lie_on_the_hand_that_is_seen(side: str) -> None:
    hand = shaped_hand(side, seed=3)
    frames = list(synthesize_sequence(motion().take(0, 20), hand, CAMERA, stride=4, device="cpu"))
    assert [frame.index for frame in frames] == list(range(5))
    for frame in frames:
        truth = frame.truth
        assert truth is not None and truth.pose is not None and truth.keypoints is not None
        assert truth.side == side
        np.testing.assert_allclose(truth.keypoints, keypoints(hand, truth.pose), atol=1e-6)
        # The keypoint that is nearest to the camera lies just under the skin that is seen there.
        nearest = truth.keypoints[np.argmin(truth.keypoints[:, 2])]
        u, v = np.rint(CAMERA.project(nearest)).astype(int)
        assert 0.0 < nearest[2] - frame.depth[v, u] < 0.02


def test_a_left_hand_shows_the_mirrored_sequence() -> None:
    right, left = (
        next(synthesize_sequence(motion(), shaped_hand(side), CAMERA, device="cpu")).depth
        for side in ("right", "left")
    )
    assert ((right > 0) != (left[:, ::-1] > 0)).mean() < 0.002


def test_noise_depends_on_seed_and_frame_alone() -> None:
    def images(stride: int, seed: int) -> np.ndarray:
        part = motion().take(0, 18)
        frames = synthesize_sequence(
            part, shaped_hand(), CAMERA, TIME_OF_FLIGHT, stride=stride, seed=seed, device="cpu"
        )
        return np.stack([frame.depth for frame in frames])

    every = images(1, 5)
    np.testing.assert_array_equal(every, images(1, 5))
    np.testing.assert_array_equal(every[::3], images(3, 5))
    assert (every != images(1, 6)).any()
    assert np.isfinite(every).all() and (every >= 0).all()


def test_frames_are_stamped_by_the_rate_of_the_motion() -> None:
    leap = Motion.load("leap_hand_motion").take(0, 9)
    frames = list(synthesize_sequence(leap, shaped_hand(), CAMERA, stride=4, device="cpu"))
    assert leap.frames_per_second is not None
    expected = np.array([0, 4, 8]) / leap.frames_per_second
    np.testing.assert_allclose([frame.time for frame in frames], expected)


def test_a_forearm_is_drawn_where_no_elbow_was_recorded() -> None:
    leap = Motion.load("leap_hand_motion").take(0, 1)
    hand = shaped_hand()
    poses, elbows = worn_by(leap, hand)
    np.testing.assert_allclose(np.linalg.norm(elbows - poses[:, :3], axis=1), FOREARM_LENGTH)
    seen = [
        (next(synthesize_sequence(leap, hand, CAMERA, NONE, forearm=arm, device="cpu")).depth > 0)
        for arm in (True, False)
    ]
    assert seen[0].sum() > 1.2 * seen[1].sum()


def test_frames_with_fingers_out_of_view_are_found() -> None:
    hand = shaped_hand()
    part = motion()
    assert not frames_out_of_view(part, hand, CAMERAS["creative"]).any()
    narrow = Camera(width=320, height=240, fx=2000.0, fy=2000.0, cx=160.0, cy=120.0)
    assert frames_out_of_view(part, hand, narrow).all()


def test_a_stride_of_nothing_is_refused_at_once() -> None:
    with pytest.raises(InputError, match="stride is 0"):
        synthesize_sequence(motion(), shaped_hand(), CAMERA, stride=0)
