"""Suite `single-frame`: frames without memory, and when a hand faces the camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.suites import single_frame
from handtrack.evaluation.suites.single_frame import facing_camera, single_frame_suite
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, load_cases, run_suite
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
from oracles.automatic import AutomaticOracle
from oracles.scenes import PALM_TO_CAMERA, shaped_hand

CasesOf = Callable[[SuiteResult], dict[str, dict[str, Any]]]


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.5), (0.25, -0.1, 0.4)])
def test_palm_and_back_face_the_camera_within_an_angle(place: tuple[float, ...]) -> None:
    hand = shaped_hand()
    # Turned about the line of the fingers, away from the direction to the camera.
    aside = rotvec_to_matrix(np.array([0.0, np.arctan2(place[0], place[2]), 0.0]))
    aside = aside @ rotvec_to_matrix(
        np.array([-np.arctan2(place[1], np.hypot(place[0], place[2])), 0.0, 0.0])
    )
    poses = np.zeros((6, 28))
    for pose, angle in zip(poses, (0, 57, 63, 117, 123, 180), strict=True):
        turn = rotvec_to_matrix(np.array([0.0, np.radians(angle), 0.0]))
        pose[3:7] = matrix_to_quat(aside @ turn @ PALM_TO_CAMERA)
        pose[:3] = place - palm_centre(keypoints(hand, pose))
    facing = facing_camera(poses, keypoints(hand, poses), 60.0)
    assert facing.tolist() == [True, True, False, False, True, True]


def test_each_frame_is_tracked_without_memory(
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    teach: Callable[[Any, str], None],
    cases_of: CasesOf,
) -> None:
    teach(single_frame, "_frames")
    off = np.zeros(28)
    off[2] = 0.03  # every keypoint 30 mm too far

    def spoilt(number: int, pose: np.ndarray) -> np.ndarray | None:
        return {0: pose + off, 1: pose + off / 2, 5: None}.get(number, pose)

    oracle.spoil = spoilt
    # With the subjects' own shapes the oracle's errors are known exactly.
    result = run_suite("single-frame", replace(quick, shape="given"))
    cases = cases_of(result)
    assert list(cases) == ["hand alone", "occluded"]
    case = cases["hand alone"]
    # 30 mm and no hand are failures, 15 mm is none.
    assert case["frames"] == 12 and case["within_20mm"] == pytest.approx(10 / 12)
    assert case["keypoint_error_mm"]["mean"] == pytest.approx((30 + 15 + 200) / 12, abs=0.1)
    assert case["states"] == {"tracking": 11, "recovered": 0, "lost": 0, "no_hand": 1}
    assert 0 < case["facing_frames"] < 12 and 0 <= case["facing_within_20mm"] <= 1
    assert case["shape"] == "given" and case["poses_given"] == 0 and not oracle.starts
    # Two variants of three subjects: everything is forgotten before each of four frames.
    assert oracle.started >= 2 * 12
    assert [curves.name for curves in result.curves] == ["mean", "worst"]
    for curves in result.curves:
        distance, share = curves.lines["hand alone, oracle"]
        assert share[np.searchsorted(distance, 31.0)] == pytest.approx(100 * 11 / 12)
    named = {overlay.name: overlay for overlay in result.overlays}
    assert len(named) == 8
    assert "sample 5: no hand, 200.0 mm" in named["single-frame-hand-alone-oracle-worst-01"].text
    worse = named["single-frame-hand-alone-oracle-worst-02"]
    assert worse.text.endswith("tracking, 30.0 mm")
    # The picture shows the very image that was tracked.
    assert worse.depth.tobytes() in oracle.answers
    assert {target.value for target in result.targets} == {"within_20mm", "facing_within_20mm"}


def test_shapes_are_given_when_asked_for(
    quick: SuiteSettings, oracle: AutomaticOracle, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    made = single_frame.HandTracker

    def noted(*arguments: Any, **options: Any) -> Any:
        told.append(options["shape"])
        return made(*arguments, **options)

    monkeypatch.setattr(single_frame, "HandTracker", noted)
    data = load_cases("single-frame")
    data["quick"] |= {"subjects": 2, "poses": 1, "variants": data["variants"][:1]}
    single_frame_suite(replace(quick, shape="mean"), data)
    assert told == [None]
    single_frame_suite(replace(quick, shape="given"), data)
    assert len(told) == 3 and not np.array_equal(told[1].alpha, told[2].alpha)


def test_trackers_that_need_a_pose_are_refused(quick: SuiteSettings) -> None:
    with pytest.raises(InputError, match="model_based needs a first pose"):
        run_suite("single-frame", replace(quick, trackers=("model_based",)))
    data = load_cases("single-frame")
    data["quick"]["variants"] = [{"case": "x", "lighting": 3}]
    with pytest.raises(InputError, match="lighting"):
        single_frame_suite(quick, data)
