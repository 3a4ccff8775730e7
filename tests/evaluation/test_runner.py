"""Running a tracker over frames: what is counted, from which pose, and how runs become cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import InputError
from handtrack.evaluation.report import check_case
from handtrack.evaluation.runner import Run, bench_case, join_runs, run_tracker
from handtrack.fitting.uncertainty import CORRELATION_LENGTH, FLOOR, OUTLINE, FitInformation
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.tracker import HandTracker
from handtrack.transforms import apply_increment
from oracles.scenes import SMALL_CAMERA, hand_model, seen_poses, shaped_hand


class ScriptedTracker:
    """Answers the depth image's first pixel with the pose of that number, and notes every reset."""

    automatic = False

    def __init__(self, poses: np.ndarray, lost: frozenset[int] = frozenset()) -> None:
        self.poses, self.lost = poses, lost
        self.calls: list[object] = []

    def reset(self, pose: np.ndarray | None = None) -> None:
        self.calls.append(None if pose is None else np.array(pose))

    def track(self, depth: np.ndarray) -> HandResult:
        number = int(depth[0, 0])
        self.calls.append(number)
        gone = number in self.lost
        return HandResult(
            state=TrackState.NO_HAND if gone else TrackState.TRACKING,
            side="right",
            pose=np.full(28, np.nan) if gone else self.poses[number],
            depth_error=np.nan if gone else 0.001 * (1 + number),
            hand=shaped_hand(),
            timings={} if gone else {"fit": 2.0, "total": 3.0},
        )


@pytest.fixture
def poses(rng: np.random.Generator) -> np.ndarray:
    return seen_poses(shaped_hand(), rng, 6)


def labelled(poses: np.ndarray, known: int | None = None) -> list[DepthFrame]:
    """Frames whose first pixel is their number; the first `known` carry their true keypoints."""
    frames = []
    for number, pose in enumerate(poses):
        depth = np.full(SMALL_CAMERA.shape, number, np.float32)
        truth = FrameTruth(keypoints=keypoints(shaped_hand(), pose).astype(np.float32))
        told = truth if known is None or number < known else None
        frames.append(DepthFrame(depth=depth, camera=SMALL_CAMERA, index=10 + number, truth=told))
    return frames


def test_every_frame_is_tracked_once_and_takes_start_with_their_pose(
    poses: np.ndarray,
) -> None:
    tracker = ScriptedTracker(poses)
    starts = {0: poses[0], 4: poses[4]}
    run = run_tracker(tracker, labelled(poses), starts)  # type: ignore[arg-type]
    # Two frames to warm up on a past that is then forgotten.
    warm = 2 * [True, 0]
    assert [call if isinstance(call, int) else call is not None for call in tracker.calls] == [
        *warm, False, True, 0, 1, 2, 3, True, 4, 5,
    ]  # fmt: skip
    given = [call for call in tracker.calls[5:] if isinstance(call, np.ndarray)]
    assert np.array_equal(np.stack(given), poses[[0, 4]])
    assert run.frames.tolist() == [10, 11, 12, 13, 14, 15]
    assert np.array_equal(run.poses, poses)
    assert run.errors_mm.max() < 1e-3  # truth is float32
    assert (run.latencies_ms > 0).all() and len(run.stages_ms) == 6
    assert all(stages == {"fit": 2.0} for stages in run.stages_ms)


def test_a_tracker_that_finds_the_hand_by_itself_is_given_no_pose(poses: np.ndarray) -> None:
    tracker = ScriptedTracker(poses)
    tracker.automatic = True
    run = run_tracker(tracker, labelled(poses), {2: poses[2], 4: poses[4]})  # type: ignore[arg-type]
    assert tracker.calls == [None, 0, None, 0, None, 0, 1, 2, 3, 4, 5]
    assert run.poses_given == 0 and bench_case(run, case="c", tracker="t")["poses_given"] == 0
    told = run_tracker(ScriptedTracker(poses), labelled(poses), {2: poses[2]})  # type: ignore[arg-type]
    assert told.poses_given == 1 and join_runs([told, run, told]).poses_given == 2


def test_frames_without_memory_forget_everything_before_each(poses: np.ndarray) -> None:
    tracker = ScriptedTracker(poses)
    run_tracker(tracker, labelled(poses)[:3], {}, memory=False)  # type: ignore[arg-type]
    assert tracker.calls == [None, 0, None, 0, None, None, 0, None, 1, None, 2]


def test_only_tracking_and_recovered_poses_are_vouched_for(poses: np.ndarray) -> None:
    run = run_tracker(
        ScriptedTracker(poses, lost=frozenset({1})),  # type: ignore[arg-type]
        labelled(poses)[:4],
        {0: poses[0]},
    )
    states = (*run.states[:2], TrackState.RECOVERED, TrackState.LOST)
    assert replace(run, states=states).sure.tolist() == [True, False, True, False]


def test_lost_and_missing_frames_are_counted(poses: np.ndarray) -> None:
    wrong = poses.copy()
    wrong[1, 0] += 0.025  # every keypoint 25 mm off: lost
    wrong[2, 1] += 0.010
    tracker = ScriptedTracker(wrong, lost=frozenset({5}))
    run = run_tracker(tracker, labelled(poses), {0: poses[0]})  # type: ignore[arg-type]
    case = bench_case(run, case="c", tracker="t", stride=3)
    check_case(case)
    assert case["frames"] == case["labelled_frames"] == 6 and case["stride"] == 3
    assert case["lost_rate"] == pytest.approx(2 / 6)
    assert case["missing_rate"] == pytest.approx(1 / 6)
    # A frame without a result counts as 200 mm off (handtrack.evaluation.metrics).
    assert case["keypoint_error_mm"]["mean"] == pytest.approx((25 + 10 + 200) / 6, abs=1e-3)
    assert case["success_rate"]["20"] == pytest.approx(4 / 6)
    assert case["success_rate"]["30"] == pytest.approx(5 / 6)
    assert case["states"] == {"tracking": 5, "recovered": 0, "lost": 0, "no_hand": 1}
    assert case["depth_error_mm"] == {"mean": pytest.approx(3.0), "median": pytest.approx(3.0)}
    assert np.isnan(run.depth_errors[5]) and run.frame_errors_mm[1] == pytest.approx(25, abs=1e-3)


class FrankTracker(ScriptedTracker):
    """Says of every frame but the lost ones how certain it is."""

    def track(self, depth: np.ndarray) -> HandResult:
        result = super().track(depth)
        if result.state is TrackState.NO_HAND:
            return result
        knows = FitInformation(
            hessian=1e6 * np.eye(27), unexplained=0.1, area=0.01, spacing=CORRELATION_LENGTH
        )
        return replace(result, information=knows)


def test_stated_deviations_are_compared_with_the_errors(poses: np.ndarray) -> None:
    # So much information leaves what all points share.
    sigma = np.hypot(0.1**2 * 0.01 / OUTLINE, FLOOR)
    wrong = poses.copy()
    wrong[1, 0] += 1.5 * sigma
    wrong[2, 1] += 2.5 * sigma
    visible = np.ones((6, 21))
    visible[:2, 3:5] = 0
    visible[3] = np.nan
    tracker = FrankTracker(wrong, lost=frozenset({5}))
    run = run_tracker(tracker, labelled(poses), {}, visible=visible)  # type: ignore[arg-type]
    np.testing.assert_allclose(run.deviations[:5], sigma, rtol=1e-3)
    assert np.isnan(run.deviations[5]).all()
    case = bench_case(run, case="c", tracker="t")
    check_case(case)
    found = case["calibration"]
    assert found["all"]["joints"] == 5 * 21
    assert found["all"]["within_1_sigma"] == pytest.approx(3 / 5)
    assert found["all"]["within_2_sigma"] == pytest.approx(4 / 5)
    assert found["hidden"]["joints"] == 4 and found["hidden"]["within_1_sigma"] == 0.5
    assert found["visible"]["joints"] == 4 * 21 - 4
    both = join_runs([run, run])
    assert both.calibration["hidden"]["joints"] == 8
    bare = run_tracker(tracker, labelled(poses, known=0), {})  # type: ignore[arg-type]
    assert not bare.calibration and "calibration" not in bench_case(bare, case="c", tracker="t")
    silent = run_tracker(ScriptedTracker(poses), labelled(poses), {})  # type: ignore[arg-type]
    assert "calibration" not in bench_case(silent, case="c", tracker="t")


def test_frames_without_truth_count_for_speed_alone(poses: np.ndarray) -> None:
    tracker = ScriptedTracker(poses)
    run = run_tracker(tracker, labelled(poses, known=2), {0: poses[0]})  # type: ignore[arg-type]
    case = bench_case(run, case="c", tracker="t")
    check_case(case)
    assert case["frames"] == 6 and case["labelled_frames"] == 2
    assert run.labelled.tolist() == [True, True, False, False, False, False]
    assert np.isnan(run.frame_errors_mm[2:]).all() and run.errors_mm.shape == (2, 21)
    bare = run_tracker(tracker, labelled(poses, known=0), {0: poses[0]})  # type: ignore[arg-type]
    case = bench_case(bare, case="c", tracker="t")
    check_case(case)
    assert "keypoint_error_mm" not in case and case["frames_per_second"] > 0


def test_joined_runs_are_measured_frame_by_frame(poses: np.ndarray) -> None:
    wrong = poses.copy()
    wrong[:, 2] += 0.006
    frames = labelled(poses)
    good = run_tracker(ScriptedTracker(poses), frames[:4], {})  # type: ignore[arg-type]
    bad = run_tracker(ScriptedTracker(wrong), frames[:2], {})  # type: ignore[arg-type]
    both = join_runs([good, bad])
    case = bench_case(both, case="all", tracker="t")
    assert len(both) == case["frames"] == 6
    assert case["keypoint_error_mm"]["mean"] == pytest.approx(2.0, abs=1e-3)
    assert isinstance(both, Run) and both.states == good.states + bad.states


def test_unusable_runs_are_refused(poses: np.ndarray) -> None:
    tracker = ScriptedTracker(poses)
    with pytest.raises(InputError, match="no frames"):
        run_tracker(tracker, [], {})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="of 6 frames"):
        run_tracker(tracker, labelled(poses), {6: poses[0]})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no runs"):
        join_runs([])


def test_a_real_tracker_follows_a_moving_hand(device: str, rng: np.random.Generator) -> None:
    hand = shaped_hand()
    start = seen_poses(hand, rng, 1)[0]
    step = np.zeros(27)
    step[0], step[4], step[12:] = 0.002, 0.01, 0.01
    path = np.stack([apply_increment(start, k * step) for k in range(6)])
    depths = DepthRenderer(hand, SMALL_CAMERA, device=device).render(path)
    frames = [
        replace(frame, depth=depth) for frame, depth in zip(labelled(path), depths, strict=True)
    ]
    tracker = HandTracker(SMALL_CAMERA, device=device, tracker="model_based", model=hand_model())
    run = run_tracker(tracker, frames, {0: start})
    assert run.errors_mm.mean() < 4.0
    assert all(state is TrackState.TRACKING for state in run.states)
    again = run_tracker(tracker, frames, {0: start})
    assert np.array_equal(again.poses, run.poses)
