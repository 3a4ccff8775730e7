"""Calibration from images: the hand is found by itself, bad images do no harm, errors tell why."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import handtrack as ht
from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.evaluation.suites.calibration_images import CalibrationImages, calibration_images
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.subjects import UnseenSubjects
from handtrack.tracking.shape_calibration import NoHandError, calibrate
from oracles.scenes import hand_model

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)
POSES = ("5", "C", "B")


def pictured(hand: ShapedHand) -> CalibrationImages:
    data = {
        "camera": CAMERA.to_dict(), "noise": "coded_light", "poses": POSES,
        "distance": [0.3, 0.4], "tilt": 15, "jitter": 4,
    }  # fmt: skip
    return calibration_images(hand, data, [3], device="cpu")


@pytest.fixture(scope="module")
def hand() -> ShapedHand:
    return UnseenSubjects.load().hand(12, hand_model())


def errors(found: ShapedHand, hand: ShapedHand) -> NDArray[np.float64]:
    return 1e3 * np.abs(found.bone_lengths - hand.bone_lengths)


@pytest.mark.slow
def test_a_hand_is_found_and_fitted_without_being_told_anything(hand) -> None:
    images = pictured(hand)
    nothing = np.zeros(CAMERA.shape, np.float32)
    fit = calibrate(
        [images.depths[0], nothing, *images.depths[1:]], CAMERA, device="cpu", model=hand_model()
    )
    assert fit.images == [0, 2, 3] and all(fit.used)
    assert fit.shape.problem is None and fit.shape.alpha_std is not None
    assert errors(hand_model().shaped(), hand).mean() > 3.0
    assert errors(fit.hand, hand).mean() < 1.6
    assert fit.errors.mean() < 0.7 * fit.mean_errors.mean()
    shaped = hand_model().shaped(fit.shape)
    np.testing.assert_allclose(shaped.bone_lengths, fit.hand.bone_lengths, rtol=1e-9)


@pytest.mark.slow
def test_named_poses_are_found_where_the_tracker_finds_nothing(hand, monkeypatch) -> None:
    images = pictured(hand)
    original = ht.HandTracker.track_batch
    # The tracker is blind; regions and names are all there is.
    monkeypatch.setattr(
        ht.HandTracker, "track_batch",
        lambda self, depths: original(self, np.zeros_like(np.asarray(depths)[:1]).repeat(3, 0)),
    )  # fmt: skip
    with pytest.raises(NoHandError, match="name the poses"):
        ht.fit_shape(images.depths, CAMERA, device="cpu", model=hand_model())
    fit = calibrate(images.depths, CAMERA, poses=POSES, device="cpu", model=hand_model())
    assert errors(fit.hand, hand).mean() < 1.8


def test_impossible_calls_say_what_is_wrong() -> None:
    nothing = np.zeros((2, *CAMERA.shape), np.float32)
    with pytest.raises(InputError, match="1 poses are named for 2 images"):
        ht.fit_shape(nothing, CAMERA, poses=["5"])
    with pytest.raises(InputError, match="no pose 'six'"):
        ht.fit_shape(nothing, CAMERA, poses=["six", None])
    with pytest.raises(InputError, match="none of 2 depth images"):
        ht.fit_shape(np.zeros((2, 5, 5), np.float32), CAMERA)
    with pytest.raises(InputError, match="none of 0"):
        ht.fit_shape([], CAMERA)
