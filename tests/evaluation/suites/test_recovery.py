"""Suite `recovery`: scrambled poses, and the frames until tracking is back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.suites import recovery
from handtrack.evaluation.suites.recovery import drawn_places, recovery_suite, scrambled
from handtrack.evaluation.suites.subjects import SubjectFrames
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, load_cases, run_suite
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.transforms import quat_to_matrix
from oracles.automatic import AutomaticOracle
from oracles.scenes import hand_model, seen_poses, shaped_hand

CasesOf = Callable[[SuiteResult], dict[str, dict[str, Any]]]


def test_a_scrambled_pose_has_any_direction_and_a_palm_nearby(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    found = np.stack([scrambled(pose, hand, rng, 0.1) for _ in range(300)])
    low, high = hand.limits.T
    assert (found[:, 7:] >= low).all() and (found[:, 7:] <= high).all()
    middles = palm_centre(keypoints(hand, found)) - palm_centre(keypoints(hand, pose))
    moved = np.linalg.norm(middles, axis=1)
    assert moved.max() <= 0.1 + 1e-9 and 0.04 < moved.mean() < 0.06
    turn = np.swapaxes(quat_to_matrix(found[:, 3:7]), 1, 2) @ quat_to_matrix(pose[3:7])
    angles = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    # Uniform rotations are 126 degrees apart on average.
    assert 115 < angles.mean() < 137


def test_frames_leave_room_before_the_take_ends(rng: np.random.Generator) -> None:
    subject = SubjectFrames(
        seed=0, shape=hand_model().sample_shape(rng), frames=[None] * 30,  # type: ignore[list-item]
        segment_starts=np.array([0, 6, 20]), visible=np.ones((30, 21), bool),
    )  # fmt: skip
    places = drawn_places(subject, 5, {"most_frames": 8}, rng)
    assert places == sorted(set(places)) and len(places) == 5
    assert set(places) <= {*range(6, 13), *range(20, 23)}
    with pytest.raises(InputError, match="room for: 10"):
        drawn_places(subject, 11, {"most_frames": 8}, rng)


def test_frames_are_counted_until_the_hand_is_found_again(
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    teach: Callable[[Any, str], None],
    cases_of: CasesOf,
) -> None:
    teach(recovery, "render_subject")
    off = np.zeros(28)
    off[0] = 0.025
    trial = iter(range(1000))
    wait = {"steps": 0}

    def slow(number: int, pose: np.ndarray) -> np.ndarray:
        """Right at once in the first two trials, in the third frame after that, never in one."""
        wait["steps"] += 1
        needed = [1, 1, 3, 3, 3, 99][wait["trial"]]
        return pose if wait["steps"] >= needed else pose + off

    made = recovery.scrambled

    def next_trial(*arguments: Any) -> np.ndarray:
        wait.update(trial=next(trial), steps=0)
        return made(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recovery, "scrambled", next_trial)
        wait["trial"] = 0
        oracle.spoil = slow
        result = run_suite("recovery", replace(quick, shape="given"))
    case = cases_of(result)["all"]
    assert case["trials"] == case["poses_given"] == 6
    assert case["within_1"] == pytest.approx(2 / 6)
    assert case["within_2"] == pytest.approx(2 / 6)
    assert case["within_3"] == case["within_5"] == case["recovered"] == pytest.approx(5 / 6)
    assert case["frames_needed"] == {"1": 2, "3": 3}
    # A trial ends when it is back, or after six frames.
    assert case["frames"] == 2 * 1 + 3 * 3 + 6
    assert case["keypoint_error_mm"]["mean"] == pytest.approx(25 / 6, abs=1e-2)
    assert case["lost_rate"] == pytest.approx(1 / 6)
    # The scrambled poses are what the tracker was told: one per trial, after warming up.
    assert len(oracle.starts) >= 6
    frames, share = result.curves[0].lines["oracle"]
    assert share[frames == 1] == pytest.approx(100 * 2 / 6)
    assert share[frames == 3] == pytest.approx(100 * 5 / 6)
    assert {target.value: target.passed for target in result.targets} == {
        "within_1": False, "within_5": False,
    }  # fmt: skip


def test_trackers_that_cannot_start_by_themselves_stand_in_the_same_table(
    quick: SuiteSettings, oracle: AutomaticOracle, teach: Callable[[Any, str], None]
) -> None:
    teach(recovery, "render_subject")
    data = load_cases("recovery")
    data["quick"] |= {"trials": 2, "most_frames": 2, "frames": [440, 446]}
    free, told = recovery_suite(replace(quick, trackers=("oracle", "model_based")), data).cases
    assert free["within_1"] == 1.0 and told["tracker"] == "model_based"
    assert told["trials"] == told["poses_given"] == 2 and told["within_1"] < 1.0
