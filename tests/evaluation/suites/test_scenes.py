"""Suite `scenes`: what is in the scenes, and what counts as a wrong pose that is vouched for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.runner import Run
from handtrack.evaluation.suites import scenes
from handtrack.evaluation.suites.scene_frames import SceneFrames, render_scene
from handtrack.evaluation.suites.scenes import (
    frames_to_find,
    scenes_suite,
    stretches,
    wrong_frames,
)
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, load_cases
from handtrack.tracking.result import TrackState
from oracles.automatic import AutomaticOracle
from oracles.scenes import shaped_hand

CasesOf = Callable[[SuiteResult], dict[str, dict[str, Any]]]

SETTINGS = SuiteSettings(device="cpu")


@pytest.fixture(scope="module")
def data() -> dict[str, Any]:
    return load_cases("scenes")


@pytest.fixture(scope="module")
def plans(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {plan["case"]: plan for plan in data["scenes"]}


def drawn(plan: dict[str, Any], data: dict[str, Any], stride: int, **more: Any) -> SceneFrames:
    """A scene without the sensor's noise, every so many frames."""
    return render_scene(
        plan | {"noise": "none"} | more, data | {"stride": stride}, SETTINGS, shaped_hand()
    )


def test_every_scene_has_a_name_of_its_own_and_a_motion_long_enough(
    data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    assert len(plans) == len(data["scenes"]) == 10
    for plan in plans.values():
        if "hand" in plan:
            first, last = plan["hand"]["frames"]
            assert last - first >= plan["frames"]
        scene = drawn(plan, data, plan["frames"] // 2)
        assert len(scene.frames) in (2, 3) and scene.frames[1].index == plan["frames"] // 2


@pytest.mark.parametrize("name", ["wall", "person", "akimbo"])
def test_scenes_without_a_hand_have_no_truth(
    name: str, data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    scene = drawn(plans[name], data, 50)
    assert not scene.in_view.any() and all(frame.truth is None for frame in scene.frames)
    assert all((frame.depth > 0).mean() > 0.2 for frame in scene.frames)


@pytest.mark.parametrize("name", ["raised hand", "two people", "ball in front", "box in front"])
def test_hands_are_in_sight_before_people_and_walls(
    name: str, data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    scene = drawn(plans[name], data, 30)
    assert scene.in_view.all()
    for frame in scene.frames:
        truth = frame.truth
        assert truth is not None and truth.keypoints is not None
        column, row = np.rint(frame.camera.project(truth.keypoints)).astype(int).T
        seen = frame.depth[row, column] - truth.keypoints[:, 2]
        # The flesh around about half of them at least; the others are behind the hand or what it
        # holds, and hardly one is seen through.
        assert ((seen > -0.03) & (seen < 0.012)).mean() > 0.45
        assert (seen < 0.012).mean() > 0.94


def test_a_hand_that_leaves_is_out_of_view_for_forty_frames(
    data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    scene = drawn(plans["hand leaves"], data, 5)
    gone = [frame.index for frame in scene.frames if frame.truth is None]
    assert gone[0] <= 50 and gone[-1] >= 90 and len(gone) * 5 >= 40
    assert scene.in_view[[0, 5, -5, -1]].all() and len(stretches(scene.in_view)) == 2
    empty = drawn(plans["hand leaves, nothing behind"], data, 70).frames[1].depth
    assert not empty.any()


def test_the_cup_moves_alone_before_the_hand_comes(
    data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    scene = drawn(plans["cup, then hand"], data, 20)
    assert stretches(scene.in_view)[-1][1] == len(scene.frames)
    first = int(np.flatnonzero(scene.in_view)[0])
    assert 70 < scene.frames[first].index < 110
    places = []
    for frame in scene.frames[:4]:
        near = (frame.depth > 0) & (frame.depth < 0.6)
        assert 500 < near.sum() < 8000
        places.append(np.argwhere(near).mean(axis=0))
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 5


def test_scenes_are_the_same_whatever_else_is_drawn(
    data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    every = render_scene(plans["akimbo"], data | {"stride": 30}, SETTINGS, shaped_hand())
    rare = render_scene(plans["akimbo"], data | {"stride": 60}, SETTINGS, shaped_hand())
    assert np.array_equal(every.frames[2].depth, rare.frames[1].depth)
    other = render_scene(
        plans["akimbo"], data | {"stride": 60}, replace(SETTINGS, seed=1), shaped_hand()
    )
    assert not np.array_equal(other.frames[1].depth, rare.frames[1].depth)
    assert every.frames[2].depth.max() <= plans["akimbo"]["reach"] + 0.05


def test_plans_that_cannot_be_drawn_are_refused(
    data: dict[str, Any], plans: dict[str, dict[str, Any]]
) -> None:
    raised = {key: value for key, value in plans["raised hand"].items() if key != "hand"}
    with pytest.raises(InputError, match="no hand"):
        drawn(raised, data, 50)
    with pytest.raises(InputError, match="'ring'"):
        ring = plans["ball in front"]["held"] | {"kind": "ring"}
        drawn(plans["ball in front"], data, 50, held=ring)
    with pytest.raises(InputError, match="the scene takes 999"):
        drawn(plans["raised hand"], data, 50, frames=999)


def run_of(states: str, errors_mm: list[float]) -> Run:
    """A run with states T R L N and mean errors [mm], NaN for frames without a hand."""
    count = len(states)
    names = {state.name[0]: state for state in TrackState}
    truth = np.zeros((count, 21, 3))
    truth[np.isnan(errors_mm)] = np.nan
    points = np.zeros((count, 21, 3))
    points[..., 0] = 1e-3 * np.nan_to_num(errors_mm)[:, None]
    return Run(
        frames=np.arange(count), poses=np.zeros((count, 28)), keypoints=points, truth=truth,
        deviations=np.full((count, 21), np.nan), visible=np.full((count, 21), np.nan),
        depth_errors=np.zeros(count), states=tuple(names[letter] for letter in states),
        latencies_ms=np.ones(count), stages_ms=({},) * count,
    )  # fmt: skip


def test_wrong_is_only_what_the_tracker_vouches_for() -> None:
    nan = np.nan
    run = run_of("TTTRRLNLNT", [5, 39, 41, 41, nan, 90, nan, nan, 90, nan])
    wrong = wrong_frames(run, 40.0)
    assert wrong.tolist() == [False, False, True, True, True, False, False, False, False, True]
    assert stretches(wrong) == [(2, 5), (9, 10)]
    assert stretches(np.zeros(3, bool)) == []
    assert stretches(np.ones(3, bool)) == [(0, 3)]


def test_the_search_is_counted_from_each_appearance() -> None:
    nan = np.nan
    run = run_of("TTNNLTTNNL", [90, 5, nan, nan, 5, 30, 10, nan, nan, 90])
    in_view = np.isfinite(run.frame_errors_mm)
    # The pose of a lost frame does not count, though it is right.
    assert frames_to_find(run, in_view, 20.0) == [2, 3, None]


def test_the_suite_counts_wrong_poses_over_all_scenes(
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    teach: Callable[[Any, str], None],
    plans: dict[str, dict[str, Any]],
    cases_of: CasesOf,
) -> None:
    teach(scenes, "render_scene")
    data = load_cases("scenes")
    off = np.zeros(28)
    off[0] = 0.06

    def spoilt(number: int, pose: np.ndarray) -> np.ndarray:
        return pose + off if number == 40 else pose

    oracle.spoil = spoilt
    few = [plans[name] for name in ("wall", "raised hand", "hand leaves", "cup, then hand")]
    data["quick"] = {"stride": 20, "scenes": few}
    result = scenes_suite(replace(quick, shape="given"), data)
    cases = cases_of(result)
    assert cases["wall"]["states"]["no_hand"] == cases["wall"]["frames"] == 5
    assert cases["wall"]["confident_wrong"] == 0 and "keypoint_error_mm" not in cases["wall"]
    case = cases["raised hand"]
    assert case["longest_wrong"] == 1 and case["confident_wrong"] == pytest.approx(1 / 8)
    assert case["frames_to_find"] == [1]
    assert len(cases["hand leaves"]["frames_to_find"]) == 2
    total = cases["all"]
    assert total["frames"] == sum(c["frames"] for name, c in cases.items() if name != "all")
    wrong = sum(c["confident_wrong"] * c["frames"] for name, c in cases.items() if name != "all")
    assert total["confident_wrong"] * total["frames"] == pytest.approx(wrong)
    assert total["poses_given"] == 0
    assert [target.value for target in result.targets] == ["confident_wrong", "longest_wrong"]
    pictures = [overlay for overlay in result.overlays if overlay.name.endswith("-040-wrong")]
    assert {overlay.text for overlay in pictures} == {"tracking, 60.0 mm"}


def test_trackers_that_need_a_pose_are_told_it_when_the_hand_is_first_in_view(
    quick: SuiteSettings, plans: dict[str, dict[str, Any]], data: dict[str, Any]
) -> None:
    settings = replace(quick, trackers=("model_based",))
    few = data | {"quick": {"stride": 60, "scenes": [plans["wall"], plans["hand leaves"]]}}
    cases = {case["case"]: case for case in scenes_suite(settings, few).cases}
    assert cases["wall"]["poses_given"] == 0 and cases["wall"]["states"]["no_hand"] == 2
    assert cases["hand leaves"]["poses_given"] == 1
