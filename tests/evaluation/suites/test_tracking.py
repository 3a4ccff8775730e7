"""Suite `tracking`: what trackers are told, and first poses that another tracker finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.suites import tracking
from handtrack.evaluation.suites.first_pose import found_starts
from handtrack.evaluation.suites.subjects import SubjectFrames, render_subject, subject_tracker
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, load_cases
from handtrack.evaluation.suites.tracking import tracking_suite
from oracles.automatic import AutomaticOracle
from oracles.scenes import hand_model

CasesOf = Callable[[SuiteResult], dict[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    """The suite's data with a few frames around a cut."""
    data = load_cases("tracking")
    data["quick"] = {"subjects": [100], "strides": [1, 2], "frames": [460, 470]}
    return data


@pytest.fixture(scope="module")
def subject(data: dict[str, Any]) -> SubjectFrames:
    part = data | data["quick"]
    return render_subject(part, 100, SuiteSettings(device="cpu"), hand_model())


def test_automatic_trackers_are_told_nothing(
    data: dict[str, Any],
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    teach: Callable[[Any, str], None],
    cases_of: CasesOf,
) -> None:
    teach(tracking, "render_subject")
    settings = replace(quick, trackers=("oracle", "model_based"), shape="given")
    result = tracking_suite(settings, data)
    assert not oracle.starts
    cases = {(case["case"], case["tracker"]): case for case in result.cases}
    free, told = (cases["all/stride-1", name] for name in settings.trackers)
    assert free["poses_given"] == 0 and free["first_pose"] == "none"
    assert told["poses_given"] == 2 and told["first_pose"] == "truth"
    assert free["keypoint_error_mm"]["mean"] < 0.01 and free["lost_rate"] == 0
    assert "oracle: no pose given" in result.notes[1]
    assert "model_based: the true pose" in result.notes[2]
    cases_of(replace(result, cases=[free]))


def test_first_poses_are_those_that_the_finder_finds(
    data: dict[str, Any],
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    teach: Callable[[Any, str], None],
) -> None:
    teach(tracking, "render_subject")
    settings = replace(quick, trackers=("model_based",), first_pose="found", shape="given")
    away = np.zeros(28)
    away[0] = 0.2

    def twenty_centimetres_off(number: int, pose: np.ndarray) -> np.ndarray:
        return pose + away

    oracle.spoil = twenty_centimetres_off
    wrong = tracking_suite(settings, data).cases[-2]
    oracle.spoil = lambda number, pose: pose
    right = tracking_suite(settings, data).cases[-2]
    assert right["case"] == "all/stride-1" and right["first_pose"] == "found"
    assert right["poses_given"] == wrong["poses_given"] == 2
    assert right["keypoint_error_mm"]["mean"] < 8.0 < wrong["keypoint_error_mm"]["mean"]


def test_a_take_starts_where_the_finder_first_finds_the_hand(
    subject: SubjectFrames, oracle: AutomaticOracle, quick: SuiteSettings
) -> None:
    frames, takes = subject.every(1)
    oracle.learn(frames)
    assert sorted(takes) == [0, 5]
    oracle.spoil = lambda number, pose: None if number in (0, 1, 5, 6, 7, 8, 9) else pose
    finder = subject_tracker(subject, quick, hand_model(), tracker="oracle")
    starts = found_starts(finder, frames, sorted(takes))
    # The second take has no frame in which it is found.
    assert list(starts) == [2]
    truth = frames[2].truth
    assert truth is not None and np.array_equal(starts[2], truth.pose)
    assert oracle.steps == 3 + 5
    with pytest.raises(InputError, match="starts by itself"):
        other = subject_tracker(subject, quick, hand_model(), tracker="model_based")
        found_starts(other, frames, [0])


def test_targets_go_with_tracker_and_shape() -> None:
    targets = load_cases("tracking")["targets"]
    old = [target for target in targets if target["tracker"] == "model_based"]
    assert all((t["shape"], t["first_pose"]) == ("given", "truth") for t in old) and len(old) == 3
    lost = {
        target["case"]: target["at_most"]
        for target in targets
        if (target["tracker"], target["shape"]) == ("hybrid", "mean")
        and target["value"] == "lost_rate"
    }
    assert lost == {"all/stride-1": 0.03, "all/stride-2": 0.05, "all/stride-4": 0.10}


def test_stated_deviations_are_judged_for_joints_in_sight_and_hidden_apart(
    data: dict[str, Any], quick: SuiteSettings
) -> None:
    # The hand is closing: fingers behind others.
    part = data | {"quick": {"subjects": [100], "strides": [1], "frames": [576, 584]}}
    settings = replace(quick, trackers=("model_based",), shape="given")
    result = tracking_suite(settings, part)
    found = {case["case"]: case["calibration"] for case in result.cases}["all/stride-1"]
    assert found["hidden"]["joints"] + found["visible"]["joints"] == found["all"]["joints"] == 168
    assert 20 < found["hidden"]["joints"] < 100
    assert found["all"]["within_1_sigma"] > 0.3 and found["all"]["within_2_sigma"] > 0.6
