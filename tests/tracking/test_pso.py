"""Particle swarm tracking: settings, repeatability, what the search gains, bad frames."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig
from handtrack.hand.kinematics import keypoints
from handtrack.hand.skeleton import ANGLES
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import TIME_OF_FLIGHT
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.pso import PsoConfig, TrackerPso, crossed_angles
from handtrack.transforms import apply_increment
from oracles.scenes import shaped_hand

CAMERA = Camera(width=160, height=120, fx=120.71, fy=120.71, cx=79.5, cy=59.5)
SMALL = PsoConfig(particles=32, generations=12)
EMPTY = np.zeros(CAMERA.shape, np.float32)


@cache
def frames(side: str = "right", count: int = 15) -> list[DepthFrame]:
    """A hand that bends its fingers, with its forearm, as a noisy sensor sees it."""
    motion = Motion.load("recorded_hand_motion").take(417, 417 + count)
    hand = shaped_hand(side)
    return list(synthesize_sequence(motion, hand, CAMERA, TIME_OF_FLIGHT, device="cpu"))


def first_pose(side: str = "right") -> np.ndarray:
    truth = frames(side)[0].truth
    assert truth is not None and truth.pose is not None
    return truth.pose


def error_mm(pose: np.ndarray | None, frame: DepthFrame, side: str = "right") -> float:
    """Mean distance of the keypoints from their true places [mm]."""
    assert pose is not None and frame.truth is not None and frame.truth.keypoints is not None
    off = keypoints(shaped_hand(side), pose) - frame.truth.keypoints
    return 1e3 * float(np.linalg.norm(off, axis=1).mean())


def depth_error_at(pose: np.ndarray, depth: np.ndarray, **options: float) -> float:
    """E_d of a pose [m]: a swarm that stays where it is."""
    spreads = {"place_spread": 0.0, "turn_spread": 0.0, "angle_spread": 0.0}
    still = PsoConfig(particles=2, generations=1, **spreads, **options)  # type: ignore[arg-type]
    tracker = TrackerPso(shaped_hand(), CAMERA, config=still, device="cpu")
    tracker.start(pose)
    return tracker.step(depth).depth_error


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"particles": 1}, "particles"),
        ({"particles": 8.5}, "particles"),
        ({"generations": 0}, "generations"),
        ({"place_spread": -0.1}, "place_spread"),
        ({"angle_spread": float("nan")}, "angle_spread"),
        ({"cognitive": "much"}, "cognitive"),
        ({"cognitive": 2.0, "social": 2.0}, "above 4"),
        ({"redraw_period": -1}, "redraw_period"),
        ({"redraw_share": 1.5}, "redraw_share"),
        ({"lost_error": 0.0}, "lost_error"),
        ({"lost_error": 0.03, "fit": FitConfig(score_cap=0.02)}, "score_cap"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        PsoConfig(**change)  # type: ignore[arg-type]


def test_defaults_are_those_of_the_papers() -> None:
    config = PsoConfig()
    assert (config.particles, config.generations) == (64, 25)
    assert config.constriction == pytest.approx(0.729844, abs=1e-6)


@pytest.mark.parametrize("side", ["right", "left"])
def test_fingers_that_point_past_each_other_are_told(side: str) -> None:
    index, middle = ANGLES.index("index_mcp_abduction"), ANGLES.index("middle_mcp_abduction")
    ring, little = ANGLES.index("ring_mcp_abduction"), ANGLES.index("little_mcp_abduction")
    angles = np.zeros((4, len(ANGLES)))
    angles[1, [index, ring, little]] = 0.3, 0.2, 0.3
    angles[2, [index, middle]] = -0.3, 0.2
    angles[3, [middle, ring]] = -0.3, -0.2
    crossed = crossed_angles(shaped_hand(side), angles)
    # Flat, fanned out, index across middle finger, middle across ring finger.
    np.testing.assert_array_equal(crossed[:2], 0.0)
    assert 0.2 < crossed[2] < 0.5 and 0.2 < crossed[3] < 0.6
    np.testing.assert_allclose(crossed, crossed_angles(shaped_hand("right"), angles), atol=1e-12)


def test_a_seed_gives_the_same_result_and_another_seed_another() -> None:
    config = PsoConfig(particles=16, generations=5)
    found = []
    tracker = TrackerPso(shaped_hand(), CAMERA, config=config, device="cpu", seed=7)
    eager = TrackerPso(shaped_hand(), CAMERA, config=config, device="cpu", seed=7, graph=False)
    other = TrackerPso(shaped_hand(), CAMERA, config=config, device="cpu", seed=8)
    for used in (tracker, tracker, eager, other):
        used.start(first_pose())
        found.append([used.step(frame.depth).pose for frame in frames()[:3]])
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_allclose(found[0], found[2], atol=1e-6)
    assert np.abs(np.subtract(found[0], found[3])).max() > 1e-3


def test_the_swarm_finds_a_better_pose_than_it_starts_from(device: str) -> None:
    frame, rng = frames()[0], np.random.default_rng(5)
    shake = np.repeat([0.008, 0.1, 0.1], [3, 3, 21]) * rng.standard_normal(27)
    start = apply_increment(first_pose(), shake)
    tracker = TrackerPso(shaped_hand(), CAMERA, device=device)
    assert not tracker.started and not tracker.automatic
    tracker.start(start)
    assert tracker.started
    estimate = tracker.step(frame.depth)
    assert estimate.found and estimate.pose is not None
    assert estimate.depth_error < 0.6 * depth_error_at(start, frame.depth)
    assert error_mm(estimate.pose, frame) < error_mm(start, frame)
    assert set(estimate.timings) == {"predict", "fit"}
    limits = shaped_hand().limits
    assert (estimate.pose[7:] >= limits[:, 0] - 1e-9).all()
    assert (estimate.pose[7:] <= limits[:, 1] + 1e-9).all()
    assert np.linalg.norm(estimate.pose[3:7]) == pytest.approx(1.0)


def test_what_crossed_fingers_cost_is_not_told_as_depth_error() -> None:
    crossed = first_pose().copy()
    crossed[7 + ANGLES.index("index_mcp_abduction")] = -0.3
    crossed[7 + ANGLES.index("middle_mcp_abduction")] = 0.3
    told = [
        depth_error_at(crossed, frames()[0].depth, crossing_weight=weight) for weight in (0.0, 1.0)
    ]
    assert told[0] == told[1] < 0.02


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_moving_hand_is_followed(side: str) -> None:
    tracker = TrackerPso(shaped_hand(side), CAMERA, config=SMALL, device="cpu")
    tracker.start(first_pose(side))
    found = [tracker.step(frame.depth) for frame in frames(side)]
    assert all(estimate.found for estimate in found)
    errors = [error_mm(e.pose, frame, side) for e, frame in zip(found, frames(side), strict=True)]
    assert max(errors) < 18.0
    moved = error_mm(first_pose(side), frames(side)[-1], side)
    assert moved > 2 * errors[-1], "standing still would not do"


def test_the_default_swarm_follows_closely() -> None:
    tracker = TrackerPso(shaped_hand(), CAMERA, device="cpu")
    tracker.start(first_pose())
    errors = [error_mm(tracker.step(frame.depth).pose, frame) for frame in frames()[:3]]
    assert np.mean(errors) < 8.0


def test_an_empty_frame_is_no_hand_and_the_next_one_is() -> None:
    tracker = TrackerPso(shaped_hand(), CAMERA, config=SMALL, device="cpu")
    tracker.start(first_pose())
    good = tracker.step(frames()[0].depth)
    assert good.found and good.pose is not None
    for _ in range(2):
        missed = tracker.step(EMPTY, fallback=good.pose)
        assert not missed.found and missed.pose is not None and np.isfinite(missed.pose).all()
        assert missed.depth_error == pytest.approx(SMALL.fit.score_cap)
    again = tracker.step(frames()[1].depth, fallback=good.pose)
    assert again.found and error_mm(again.pose, frames()[1]) < 15.0


def test_a_fallback_brings_a_swarm_back_that_went_astray() -> None:
    frame = frames()[0]
    astray = first_pose().copy()
    astray[0] += 0.12
    found = {}
    for fallback in (None, first_pose()):
        tracker = TrackerPso(shaped_hand(), CAMERA, config=SMALL, device="cpu")
        tracker.start(astray)
        found[fallback is not None] = tracker.step(frame.depth, fallback=fallback)
    assert error_mm(found[False].pose, frame) > 30.0
    assert found[True].found and error_mm(found[True].pose, frame) < 15.0
