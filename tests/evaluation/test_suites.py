"""The suites of `handtrack bench`: their data, their motion, and a small run of each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import InputError, MissingFileError
from handtrack.evaluation.report import bench_document
from handtrack.evaluation.suites import speed
from handtrack.evaluation.suites.ablation import changed, variants
from handtrack.evaluation.suites.fist import fist_motion, minimum_jerk
from handtrack.evaluation.suites.stages import StagedFitter
from handtrack.evaluation.suites.start_up import StartUpError, measure_start
from handtrack.evaluation.suites.subjects import SubjectFrames, render_subject
from handtrack.evaluation.suites.suite import (
    SUITES,
    RecordedFrames,
    SuiteResult,
    SuiteSettings,
    chosen,
    judged,
    load_cases,
    run_suite,
)
from handtrack.grasp.controller import VARIANTS
from handtrack.hand.kinematics import keypoints, skin, skin_normals
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import TIP_KEYPOINTS
from handtrack.tracking.model_based import ModelBasedConfig
from handtrack.tracking.tracker import TRACKERS
from oracles.scenes import hand_model, shaped_hand
from oracles.winding import winding_numbers

QUICK = SuiteSettings(quick=True, device="cpu", shape="given")


def check_document(result: SuiteResult) -> dict[str, dict[str, Any]]:
    """Cases by name, after the checks that writing the benchmark file makes."""
    document = bench_document(result.suite, "cpu", result.cases, **result.more)
    return {case["case"]: case for case in document["cases"]}


@pytest.mark.parametrize("name", SUITES)
def test_the_data_of_every_suite_names_what_there_is(name: str) -> None:
    data = load_cases(name)
    # What the suite grasp compares are controllers.
    known = VARIANTS if name == "grasp" else TRACKERS
    assert data["trackers"] and set(data["trackers"]) <= set(known)
    for target in data.get("targets", ()):
        assert {"case", "value"} < set(target) and ("at_most" in target) != ("at_least" in target)
        # The suite shape measures ways to find a shape beside the trackers.
        assert target.get("tracker", data["trackers"][0]) in {*known, "fit_shape", "adapted"}
    # What --quick replaces must be entries that the suite reads.
    optional = {"frames"}
    assert set(data.get("quick", {})) <= set(data) | optional


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="selftest, tracking"):
        run_suite("races", QUICK)
    with pytest.raises(InputError, match="model_based"):
        run_suite("selftest", replace(QUICK, trackers=("model_based", "oracle")))
    with pytest.raises(InputError, match="each one once"):
        run_suite("selftest", replace(QUICK, trackers=("thesis", "thesis")))


def test_targets_are_judged_on_the_first_tracker_or_the_one_they_name() -> None:
    cases = [
        {"case": "a", "tracker": "t", "error": {"mean": 2.0}, "rate": 50.0, "shape": "given"},
        {"case": "a", "tracker": "other", "error": {"mean": 9.0}, "rate": 9.0, "shape": "mean"},
    ]
    targets = [
        {"case": "a", "value": "error.mean", "at_most": 2.0},
        {"case": "a", "value": "rate", "at_least": 60},
        {"case": "left out by quick", "value": "rate", "at_least": 60},
    ]
    found = judged(cases, targets, "t")
    assert [(target.reached, target.passed) for target in found] == [(2.0, True), (50.0, False)]
    assert found[1].to_dict()["at_least"] == 60.0
    # Whatever else a target names must be so of the case.
    rate = {"case": "a", "value": "rate", "at_least": 5}
    assert [t.tracker for t in judged(cases, [rate | {"tracker": "other"}], "t")] == ["other"]
    assert len(judged(cases, [rate | {"shape": "given"}], "t")) == 1
    assert not judged(cases, [rate | {"shape": "mean"}, rate | {"first_pose": "found"}], "t")
    assert judged(cases, [rate | {"tracker": "other", "shape": "mean"}], "t")[0].reached == 9.0


# selftest


def test_the_hand_makes_a_fist_twice_and_opens_again() -> None:
    hand = shaped_hand()
    motion = fist_motion(load_cases("selftest"), hand)
    assert len(motion) == 160
    poses = motion.to_poses()
    low, high = hand.limits.T
    assert (poses[:, 7:] >= low - 1e-6).all() and (poses[:, 7:] <= high + 1e-6).all()
    points = keypoints(hand, poses)
    # No jump: at video rate a fingertip moves 16 mm per frame at most.
    assert np.linalg.norm(np.diff(points, axis=0), axis=-1).max() < 0.018
    tips = points[:, list(TIP_KEYPOINTS[1:])]
    reach = np.linalg.norm(tips - points[:, :1], axis=-1).mean(axis=1)
    closed = reach < 0.6 * reach[0]
    assert np.flatnonzero(np.diff(closed.astype(int)) == 1).size == 2
    assert not closed[[0, 78, 159]].any() and closed[[40, 124]].all()
    spread = np.linalg.norm(tips[:, 0] - tips[:, 3], axis=-1)
    assert spread[87] > 1.4 * spread[0]


@pytest.mark.parametrize("frame", [0, 41, 112])
def test_the_hand_of_the_selftest_does_not_pass_through_itself(frame: int) -> None:
    hand = shaped_hand()
    pose = fist_motion(load_cases("selftest"), hand).to_poses()[frame]
    vertices, normals = skin(hand, pose), skin_normals(hand, pose)
    bones = hand.weight_bones[np.arange(hand.nvert), hand.weights.argmax(axis=1)]
    # Skin folds where a finger or the thumb's flesh joins the palm: look at the bones beyond.
    free = np.flatnonzero((bones > 1) & (bones % 3 != 1))[::2]
    within = winding_numbers(vertices, hand.faces, vertices[free] + 5e-4 * normals[free]) > 0.5
    depths = []
    for vertex in free[within]:
        chain = (bones[vertex] - 1) // 3
        others = np.flatnonzero((bones == 0) | ((bones - 1) // 3 != chain))
        nearest = others[np.linalg.norm(vertices[others] - vertices[vertex], axis=1).argmin()]
        depths.append((vertices[nearest] - vertices[vertex]) @ normals[nearest])
    # Fingers press on each other and on the palm by no more than flesh gives way.
    assert max(depths, default=0.0) < 0.0035


def test_minimum_jerk_starts_and_ends_at_rest() -> None:
    share = np.linspace(-0.5, 1.5, 401)
    way = minimum_jerk(share)
    assert way[0] == 0 and way[-1] == 1 and minimum_jerk(np.array(0.5)) == 0.5
    assert (np.diff(way) >= 0).all()
    assert abs(np.gradient(way, share)[[100, 300]]).max() < 1e-2


def test_selftest_measures_phalanges_without_noise() -> None:
    result = run_suite("selftest", QUICK)
    case = check_document(result)["selftest"]
    assert case["frames"] == load_cases("selftest")["quick"]["frames"]
    phalanx = case["phalanx_error_mm"]
    assert 0 < phalanx["mean"] < 5.0 and phalanx["mean"] <= phalanx["max_frame"]
    assert result.errors_mm["model_based"].shape == (case["frames"], 16)
    assert phalanx["mean"] == pytest.approx(result.errors_mm["model_based"].mean())
    assert [target.value.split(".")[1] for target in result.targets] == ["mean", "max_frame"]


# tracking


@pytest.fixture(scope="module")
def subject() -> SubjectFrames:
    """A few noisy frames around a cut of the recorded motion."""
    data = load_cases("tracking") | {"frames": [462, 472]}
    return render_subject(data, 100, QUICK, hand_model())


def test_takes_start_with_their_true_pose_at_every_frame_rate(subject: SubjectFrames) -> None:
    assert subject.segment_starts.tolist() == [0, 3]
    for stride, places in ((1, [0, 3]), (2, [0, 2]), (4, [0, 1])):
        frames, starts = subject.every(stride)
        assert [frame.index for frame in frames] == list(range(0, 10, stride))
        assert sorted(starts) == places
        for place, pose in starts.items():
            truth = frames[place].truth
            assert truth is not None and np.array_equal(pose, truth.pose)


def test_subjects_are_the_same_in_every_run(subject: SubjectFrames) -> None:
    data = load_cases("tracking") | {"frames": [462, 464]}
    again = render_subject(data, 100, QUICK, hand_model())
    other = render_subject(data, 101, QUICK, hand_model())
    assert np.array_equal(again.shape.alpha, subject.shape.alpha)
    assert np.array_equal(again.frames[1].depth, subject.frames[1].depth)
    assert not np.array_equal(other.frames[1].depth, subject.frames[1].depth)
    # Noise and forearm are in the image: rough surface, and more than the hand.
    depth = subject.frames[1].depth
    assert len(np.unique(depth[depth > 0])) > 30


def test_tracking_gives_one_case_per_subject_and_frame_rate_and_over_all() -> None:
    result = run_suite("tracking", replace(QUICK, trackers=("model_based", "thesis")))
    cases = [case for case in result.cases if case["tracker"] == "model_based"]
    named = {case["case"]: case for case in cases}
    assert list(named) == [
        "subject-0/stride-1", "subject-0/stride-4", "all/stride-1", "all/stride-4",
    ]  # fmt: skip
    first, last = load_cases("tracking")["quick"]["frames"]
    assert named["all/stride-1"]["frames"] == last - first
    assert named["all/stride-4"]["frames"] == -(-(last - first) // 4)
    assert named["all/stride-1"]["keypoint_error_mm"]["mean"] < 8.0
    assert (
        named["all/stride-1"]["keypoint_error_mm"]
        == (named["subject-0/stride-1"]["keypoint_error_mm"])
    )
    assert {target.case for target in result.targets} == {"all/stride-1"}
    assert all(target.tracker == "model_based" for target in result.targets)
    assert len(result.cases) == 8 and len(result.errors_mm) == 4
    bench_document("tracking", "cpu", result.cases)


def test_the_mean_hand_is_measured_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from handtrack.evaluation.suites import subjects

    told = []
    made = subjects.HandTracker
    monkeypatch.setattr(
        subjects, "HandTracker", lambda *a, **k: told.append(k["shape"]) or made(*a, **k)
    )
    data = load_cases("tracking")
    data["quick"] = data["quick"] | {"frames": [100, 103], "strides": [1]}
    from handtrack.evaluation.suites.tracking import tracking_suite

    result = tracking_suite(replace(QUICK, shape="mean"), data)
    assert told == [None] and result.cases[0]["shape"] == "mean"
    tracking_suite(QUICK, data)
    assert isinstance(told[1], HandShape)


# ablation


def test_every_switch_changes_the_default_and_has_two_states() -> None:
    default = TRACKERS["model_based"]
    switches = load_cases("ablation")["switches"]
    found = variants(default, switches)
    assert found[0] == ("default", default)
    assert len(found) == 1 + len(switches)
    for switch, (name, config) in zip(switches, found[1:], strict=True):
        off, on = (changed(default, switch[state]) for state in ("off", "on"))
        assert off != on
        assert config != default and config in (off, on)
        assert name == f"{'with' if off == default else 'without'} {switch['name']}"
    assert len({name for name, _ in found}) == len(found)


def test_changes_name_fields_or_take_the_value_of_one() -> None:
    config = ModelBasedConfig()
    assert changed(config, {"fit.iterations": 2, "velocity": 0.5}).fit.iterations == 2
    annealed = changed(config, {"fit.robust_start": "fit.robust_scale"})
    assert annealed.fit.robust_start == config.fit.robust_scale
    assert annealed.fit.robust_scale == config.fit.robust_scale
    with pytest.raises(InputError, match=r"fit\.nonsense"):
        changed(config, {"fit.nonsense": 1})


def test_ablation_measures_the_default_and_every_variant() -> None:
    data = load_cases("ablation")
    data["quick"] = data["quick"] | {"frames": [440, 448]}
    from handtrack.evaluation.suites.ablation import ablation_suite

    result = ablation_suite(QUICK, data)
    names = [case["case"].split("/")[0] for case in result.cases]
    assert names[0] == "default" and len(set(names)) == len(names) == 3
    assert all(case["frames"] == 2 for case in result.cases)
    check_document(result)


def test_a_variant_whose_artifact_is_missing_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    from handtrack.evaluation.suites import ablation

    def no_prior(*_: object, config: ModelBasedConfig, **__: object) -> object:
        if config.fit.prior_weight > 0:
            raise MissingFileError("no pose_prior.npz")
        return run(*_, config=config, **__)

    run = ablation.track_subject
    monkeypatch.setattr(ablation, "track_subject", no_prior)
    data = load_cases("ablation")
    prior = {"name": "prior", "off": {"fit.prior_weight": 0}, "on": {"fit.prior_weight": 0.3}}
    data["quick"] = data["quick"] | {"frames": [440, 442], "switches": [prior]}
    result = ablation.ablation_suite(QUICK, data)
    left_out = [note for note in result.notes if "no pose_prior.npz" in note]
    assert len(left_out) == 1 and len(result.cases) == 1


# speed


def test_staged_and_whole_frames_give_the_same_pose(subject: SubjectFrames) -> None:
    hand = hand_model().shaped(subject.shape)
    frame, before = subject.frames[1], subject.frames[0].truth
    assert before is not None and before.pose is not None
    for rows in (1, 3):
        fitter = StagedFitter([hand], frame.camera, nhyp=rows, device="cpu", threads=2)
        starts = np.tile(before.pose, (rows, 1))
        found = []
        for run in (fitter.run, fitter.run_staged, fitter.run_staged):
            speed._load(fitter, hand, frame.depth, starts)
            spent = run()
            found.append((fitter.poses, fitter.errors))
        for poses, errors in found[1:]:
            assert np.array_equal(poses, found[0][0]) and np.array_equal(errors, found[0][1])
        assert not np.array_equal(found[0][0], starts.astype(np.float32))
        assert spent is not None and all(milliseconds >= 0 for milliseconds in spent.values())
        assert {"prepare", "correspondences", "residuals", "solve", "render+score"} <= set(spent)


def test_speed_measures_rows_stages_and_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        speed, "measure_start", lambda device, cold: {"import": 2.0 if cold else 1.0}
    )
    result = run_suite("speed", replace(QUICK, cold=True))
    cases = check_document(result)
    assert list(cases) == ["rows-1", "rows-4"]
    for case in cases.values():
        assert case["iterations"] == 4 and case["frames"] >= 11
        assert list(case["stage_ms"])[:2] == ["check", "upload"]
        assert list(case["stage_ms"])[-1] == "download"
        # Loose: other work on the machine may come between the two passes.
        ratio = sum(case["stage_ms"].values()) / case["latency_ms"]["p50"]
        assert 0.2 < ratio < 5.0
    assert "added_hypothesis_ms" in cases["rows-4"]
    assert "added_hypothesis_ms" not in cases["rows-1"]
    assert result.more["start_seconds"] == {"warm": {"import": 1.0}, "cold": {"import": 2.0}}
    assert cases["rows-4"]["workspace_mb"] > cases["rows-1"]["workspace_mb"] > 0.1


def test_first_hypotheses_start_from_the_frame_before(subject: SubjectFrames) -> None:
    starts = speed._start_poses(subject.frames, 3, [0.005, 0.1, 0.15], seed=1)
    assert len(starts) == len(subject.frames) - 1
    for frame, poses in zip(subject.frames, starts, strict=False):
        assert frame.truth is not None and frame.truth.pose is not None
        assert np.allclose(poses[0], frame.truth.pose) and not np.allclose(poses[1], poses[0])
        assert np.linalg.norm(poses[1:, :3] - poses[0, :3], axis=1).max() < 0.03


def test_a_start_in_its_own_process_is_timed() -> None:
    spent = measure_start("cpu", cold=False)
    assert list(spent) == ["import", "construct", "first frame"]
    assert all(0 < seconds < 120 for seconds in spent.values())
    with pytest.raises(StartUpError, match="cuda:99"):
        measure_start("cuda:99", cold=False)


# real and sequence


@pytest.mark.data
def test_real_images_start_from_their_labels(recordings: Path) -> None:
    result = run_suite("real", replace(QUICK, trackers=("model_based",), data=recordings))
    case = check_document(result)["nyu_test_0001740_crop"]
    assert case["start_error_mm"] < 5.0 and 0.8 < case["scale"] < 1.5
    assert case["keypoint_error_mm"]["mean"] < 15.0
    assert result.errors_mm["nyu_test_0001740_crop, model_based"].shape == (3, 14)
    assert [overlay.name.split("-")[-1] for overlay in result.overlays] == ["start", "fitted"]
    assert "not startable" in result.notes[-1] and "sr305" in result.notes[-1]


def test_real_needs_the_recordings(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--data"):
        run_suite("real", QUICK)
    with pytest.raises(MissingFileError):
        run_suite("real", replace(QUICK, data=tmp_path))


def test_a_recorded_sequence_is_tracked_from_its_first_labels(subject: SubjectFrames) -> None:
    frames = [replace(frame, index=place) for place, frame in enumerate(subject.frames[:6])]
    # Labels of the first two frames are missing; those of the last one too.
    for place in (0, 1, 5):
        frames[place] = replace(frames[place], truth=None)
    truth: FrameTruth | None = frames[2].truth
    assert truth is not None and truth.pose is not None
    recorded = RecordedFrames(
        name="r", frames=frames, starts={2: truth.pose}, side="right", shape=subject.shape
    )
    seen: list[DepthFrame] = []

    def watch(items: Iterable[DepthFrame], total: int, text: str) -> Iterator[DepthFrame]:
        assert (total, text) == (4, "model_based")
        for item in items:
            seen.append(item)
            yield item

    settings = replace(QUICK, quick=False, sequence=recorded, progress=watch)
    result = run_suite("sequence", settings)
    case = check_document(result)["r"]
    assert [frame.index for frame in seen] == [2, 3, 4, 5]
    assert case["frames"] == 4 and case["labelled_frames"] == 3
    assert case["keypoint_error_mm"]["mean"] < 8.0
    assert len(result.overlays) == 3
    with pytest.raises(InputError, match="--sequence"):
        run_suite("sequence", QUICK)


def test_quick_replaces_entries_and_trackers_are_chosen() -> None:
    cases = {"a": 1, "b": 2, "trackers": ["model_based"], "quick": {"a": 3}}
    assert chosen(SuiteSettings(), cases) == {"a": 1, "b": 2, "trackers": ["model_based"]}
    assert chosen(QUICK, cases)["a"] == 3
    assert chosen(SuiteSettings(trackers=("thesis",)), cases)["trackers"] == ["thesis"]
