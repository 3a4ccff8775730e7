from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtrack.errors import InputError
from handtrack.evaluation.metrics import (
    MISSING_ERROR_MM,
    PHALANGES,
    SEGMENTS,
    calibration,
    keypoint_errors,
    lost_rate,
    missing_frames,
    phalanx_errors,
    phalanx_summary,
    success_curve,
    success_rate,
    summarize,
    summarize_errors,
)
from handtrack.hand.skeleton import KEYPOINTS


def test_errors_are_distances_in_millimetres() -> None:
    truth = np.zeros((2, 3, 3), np.float32)
    predicted = truth.copy()
    predicted[0, 1] = (0.003, 0.0, 0.004)
    predicted[1, 2] = (0.0, -0.02, 0.0)
    errors = keypoint_errors(predicted, truth)
    assert errors.dtype == np.float64
    assert errors == pytest.approx(np.array([[0, 5, 0], [0, 0, 20]]), abs=1e-5)


def test_success_counts_the_worst_joint_and_lost_the_mean() -> None:
    errors = np.array([[1.0, 20.0], [5.0, 21.0], [39.0, 1.5], [20.0, 20.5]])
    assert success_rate(errors) == {"20": 0.25, "30": 0.75, "40": 1.0}
    assert success_rate(errors, (2.5, 20.5)) == {"2.5": 0.0, "20.5": 0.5}
    # Means 10.5, 13, 20.25, 20.25.
    assert lost_rate(errors) == 0.5
    assert lost_rate(np.array([[20.0, 20.0]])) == 0.0


def test_curve_agrees_with_the_rates_and_takes_any_order(rng: np.random.Generator) -> None:
    errors = rng.gamma(2.0, 8.0, (200, 14))
    thresholds = np.array([40.0, 20.0, 30.0])
    assert success_curve(errors, thresholds).tolist() == [
        success_rate(errors)[key] for key in ("40", "20", "30")
    ]
    curve = success_curve(errors, np.linspace(0, 200, 50))
    assert (np.diff(curve) >= 0).all() and curve[0] == 0 and curve[-1] == 1


def test_missing_predictions_count_as_failures() -> None:
    truth = np.zeros((4, 21, 3))
    predicted = truth.copy()
    predicted[1, 5] = np.nan
    predicted[2, :, 0] = np.inf
    predicted[3, 0, 0] = 1e200
    errors = keypoint_errors(predicted, truth)
    assert np.isfinite(errors).all()
    assert errors[1, 5] == MISSING_ERROR_MM and errors[1].sum() == MISSING_ERROR_MM
    assert (errors[2] == MISSING_ERROR_MM).all()
    assert missing_frames(predicted).tolist() == [False, True, True, False]
    summary = summarize(predicted, truth)
    assert summary.missing_rate == 0.5
    assert summary.success_rate == {"20": 0.25, "30": 0.25, "40": 0.25}
    assert summary.lost_rate == 0.25
    assert np.isfinite([summary.mean_mm, summary.median_mm, summary.p95_mm]).all()


def test_leaving_a_frame_out_never_helps_below_the_penalty(rng: np.random.Generator) -> None:
    truth = rng.normal(size=(30, 21, 3)) * 0.1
    predicted = truth + rng.normal(size=truth.shape) * 0.02
    whole = summarize(predicted, truth)
    predicted[3] = np.nan
    less = summarize(predicted, truth)
    assert less.mean_mm > whole.mean_mm
    assert all(less.success_rate[key] <= whole.success_rate[key] for key in whole.success_rate)


def test_summary_pools_all_joints_of_all_frames(rng: np.random.Generator) -> None:
    errors = rng.gamma(2.0, 5.0, (50, 7))
    summary = summarize_errors(errors, missing_rate=0.1)
    assert summary.frames == 50
    assert summary.mean_mm == pytest.approx(errors.mean())
    assert summary.median_mm == pytest.approx(np.median(errors))
    assert summary.p95_mm == pytest.approx(np.percentile(errors, 95))
    assert summary.to_dict()["keypoint_error_mm"]["p95"] == summary.p95_mm
    assert summary.to_dict()["missing_rate"] == 0.1


def test_phalanges_join_neighbouring_keypoints_of_one_finger() -> None:
    assert len(PHALANGES) == 15 and len(SEGMENTS) == 16
    for proximal, distal in PHALANGES:
        assert distal == proximal + 1
        assert KEYPOINTS[proximal].split("_")[0] == KEYPOINTS[distal].split("_")[0]
    assert SEGMENTS[-1] == (KEYPOINTS.index("wrist"), KEYPOINTS.index("middle_mcp"))


def test_phalanx_error_is_the_mean_of_its_end_points() -> None:
    truth = np.zeros((2, 21, 3))
    predicted = truth.copy()
    predicted[0, 8] = (0.010, 0.0, 0.0)
    errors = phalanx_errors(predicted, truth)
    expected = np.zeros((2, 16))
    expected[0, SEGMENTS.index((7, 8))] = 5.0
    assert errors == pytest.approx(expected)
    assert phalanx_errors(predicted, truth, palm=False).shape == (2, 15)
    assert phalanx_summary(predicted, truth) == pytest.approx(
        {"mean": 5 / 32, "median": 5 / 32, "max_frame": 5 / 16}
    )


@given(st.floats(0.0, 0.1), st.integers(1, 5))
def test_a_shift_of_everything_is_the_error_of_everything(shift: float, frames: int) -> None:
    truth = np.random.default_rng(frames).normal(size=(frames, 21, 3))
    predicted = truth + shift * np.array([2.0, -1.0, 2.0]) / 3.0
    assert phalanx_errors(predicted, truth) == pytest.approx(1e3 * shift, abs=1e-6)
    assert summarize(predicted, truth).mean_mm == pytest.approx(1e3 * shift, abs=1e-6)


@pytest.mark.parametrize(
    ("predicted", "truth", "words"),
    [
        ((5, 21, 3), (4, 21, 3), r"\(5, 21, 3\).*\(4, 21, 3\)"),
        ((5, 21, 2), (5, 21, 2), "njoint, 3"),
        ((0, 21, 3), (0, 21, 3), "at least one frame"),
    ],
)
def test_shapes_that_cannot_be_compared_are_refused(
    predicted: tuple[int, ...], truth: tuple[int, ...], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        keypoint_errors(np.zeros(predicted), np.zeros(truth))


def test_a_truth_that_is_not_finite_is_refused() -> None:
    truth = np.zeros((3, 21, 3))
    truth[1, 0, 0] = np.nan
    with pytest.raises(InputError, match="not finite in 1 frames"):
        keypoint_errors(np.zeros((3, 21, 3)), truth)
    with pytest.raises(InputError, match="21 keypoints"):
        phalanx_errors(np.zeros((3, 14, 3)), np.zeros((3, 14, 3)))
    with pytest.raises(InputError, match="njoint"):
        success_rate(np.zeros(4))


def test_calibration_counts_visible_and_hidden_joints_apart() -> None:
    errors = np.array([[1.0, 2.0, 3.0, 9.0], [0.5, 4.0, 4.1, 1.0]])
    sigma = np.full(errors.shape, 2.0)
    sigma[0, 3] = np.nan
    visible = np.array([[1, 1, 0, 0], [1, 0, 0, np.nan]])
    found = calibration(errors, sigma, visible)
    # On the bound counts as within.
    assert found["visible"] == {
        "joints": 3, "within_1_sigma": 1.0, "within_2_sigma": 1.0, "median_sigma_mm": 2.0,
        "median_error_mm": 1.0,
    }  # fmt: skip
    assert found["hidden"]["joints"] == 3
    assert found["hidden"]["within_1_sigma"] == 0
    assert found["hidden"]["within_2_sigma"] == pytest.approx(2 / 3)
    # A joint of unknown visibility counts here alone, one without a deviation nowhere.
    assert found["all"]["joints"] == 7
    assert found["all"]["within_1_sigma"] == pytest.approx(4 / 7)
    assert calibration(errors, sigma) == {"all": found["all"]}
    assert calibration(errors, np.full(errors.shape, np.nan), visible) == {}


def test_gaussian_errors_are_calibrated_as_the_docstring_says(rng: np.random.Generator) -> None:
    for axes, one, two in ((1, 0.683, 0.954), (3, 0.608, 0.993)):
        steps = rng.normal(size=(20000, 21, axes))
        found = calibration(np.linalg.norm(steps, axis=-1), np.full((20000, 21), axes**0.5))
        assert found["all"]["within_1_sigma"] == pytest.approx(one, abs=0.004)
        assert found["all"]["within_2_sigma"] == pytest.approx(two, abs=0.004)


def test_calibration_needs_equal_shapes() -> None:
    with pytest.raises(InputError, match=r"\(3, 21\).*\(2, 21\)"):
        calibration(np.zeros((3, 21)), np.zeros((2, 21)))
    with pytest.raises(InputError, match=r"\(3, 20\)"):
        calibration(np.zeros((3, 21)), np.zeros((3, 21)), np.zeros((3, 20)))
