"""Reaching, manipulation and releasing: ends are met, shape and speed come from recordings."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.recording import GraspDatabase, turned_poses
from handtrack.grasp.trajectory import EditWeights, carried, edited, reach, release, transport
from handtrack.transforms import (
    matrix_to_quat,
    matrix_to_rotvec,
    pose_difference,
    quat_to_matrix,
    rotvec_to_matrix,
)
from oracles.made_recordings import make_database, make_recording

DATABASE = make_database()


def wave(count: int = 60) -> np.ndarray:
    t = np.linspace(0.0, 1.0, count)
    return np.stack([np.sin(3.0 * t), t**2, np.cos(5.0 * t)], axis=1)


def test_an_edited_motion_meets_its_ends_and_keeps_second_differences() -> None:
    example = wave()
    first, last = example[0] + [0.1, 0.0, -0.2], example[-1] + [0.0, 0.3, 0.1]
    motion = edited(example, first=first, last=last)
    np.testing.assert_allclose(motion[[0, -1]], [first, last], atol=1e-7)
    np.testing.assert_allclose(np.diff(motion, 2, axis=0), np.diff(example, 2, axis=0), atol=1e-9)


def test_editing_finds_the_minimum_of_its_energy(rng: np.random.Generator) -> None:
    example, weights = wave(20), EditWeights(ends=10.0, joins=0.01)
    first, last, before, after = rng.normal(size=(4, 3))

    def energy(q: np.ndarray) -> float:
        bend = ((np.diff(q, 2, axis=0) - np.diff(example, 2, axis=0)) ** 2).sum()
        ends = ((q[0] - first) ** 2).sum() + ((q[-1] - last) ** 2).sum()
        joins = ((before + q[1] - 2 * q[0]) ** 2).sum() + ((after + q[-2] - 2 * q[-1]) ** 2).sum()
        return float(bend + weights.ends * ends + weights.joins * joins)

    best = edited(example, first=first, last=last, before=before, after=after, weights=weights)
    for _ in range(50):
        other = best + 1e-3 * rng.normal(size=best.shape)
        assert energy(other) > energy(best)


def test_a_frame_outside_takes_the_jump_of_speed_away() -> None:
    example = wave()
    first = example[0] + 0.3
    jump = edited(example, first=first, last=example[-1])
    smooth = edited(example, first=first, last=example[-1], before=first)
    asked = np.abs(smooth[1] - smooth[0]).max()
    assert asked < 0.2 * np.abs(jump[1] - jump[0]).max()
    np.testing.assert_allclose(smooth[0], first, atol=2e-3)


def closing_elsewhere(seed: int = 3) -> np.ndarray:
    """Another closing motion, somewhere in the world."""
    motion = make_recording(np.random.default_rng(seed)).closing_in_grasp_frame
    return turned_poses(motion, 2.0, [0.3, -0.2, 0.05])


def test_the_hand_reaches_from_its_start_to_where_closing_begins() -> None:
    closing = closing_elsewhere()
    start = closing[0].copy()
    start[:3] += [-0.25, 0.2, 0.15]
    start[7:] = 0.3
    path = reach(DATABASE, "tripod", start, closing, 60.0)
    np.testing.assert_allclose(path[0], start, atol=2e-3)
    np.testing.assert_array_equal(path[-1], closing[0])
    np.testing.assert_allclose(np.linalg.norm(path[:, 3:7], axis=1), 1.0, atol=1e-9)
    # At rest at first, and no jump from one frame to the next.
    steps = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
    assert steps[0] < 0.3 * steps.max() and steps.max() < 0.03
    assert np.abs(np.diff(path[:, 7:], axis=0)).max() < 0.15


def test_without_a_start_the_hand_comes_as_in_a_recording() -> None:
    recording = DATABASE.recordings[4]
    closing = turned_poses(recording.closing_in_grasp_frame, 1.1, [0.0, 0.4, 0.1])
    path = reach(GraspDatabase((recording,)), "tripod", None, closing, 120.0)
    wanted = turned_poses(recording.hand_poses[recording.of_phase("reaching")], 1.1, [0, 0.4, 0.1])
    assert len(path) == len(wanted)
    assert np.abs(pose_difference(path, wanted)).max() < 0.03


def test_longer_ways_take_longer() -> None:
    closing = closing_elsewhere()
    near, far = closing[0].copy(), closing[0].copy()
    near[:3] += [-0.05, 0.0, 0.05]
    far[:3] += [-0.4, 0.0, 0.3]
    times = [len(reach(DATABASE, "tripod", start, closing, 60.0)) for start in (near, far)]
    assert times[0] < times[1]


def test_an_object_is_carried_from_start_to_target_and_rises_on_the_way() -> None:
    start = np.array([0.1, 0.2, 0.03, *matrix_to_quat(rotvec_to_matrix(np.array([0, 0, 1.0])))])
    target = start.copy()
    target[:3] += [-0.1, 0.18, 0.0]
    target[3:] = matrix_to_quat(rotvec_to_matrix(np.array([0.0, 0.0, 1.4])))
    path = transport(DATABASE, start, target, 60.0)
    np.testing.assert_array_equal(path[[0, -1]], [start, target])
    assert path[:, 2].max() > 0.1 and path[:, 2].min() > 0.029
    speed = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)
    assert max(speed[0], speed[-1]) < 0.2 * speed.max()
    turns = quat_to_matrix(path[:, 3:])
    steps = matrix_to_rotvec(np.swapaxes(turns[:-1], 1, 2) @ turns[1:])
    assert np.linalg.norm(steps, axis=1).max() < 0.06


def test_a_lift_alone_is_a_lift() -> None:
    start = np.array([0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0])
    target = start.copy()
    target[2] += 0.12
    path = transport(DATABASE, start, target, 60.0)
    np.testing.assert_array_equal(path[-1], target)
    assert np.linalg.norm(path[:, :2], axis=1).max() < 0.2


def test_a_held_object_stays_in_the_hand() -> None:
    recording = DATABASE.recordings[0]
    grasp, frames = recording.hand_poses[recording.grasp_frame], recording.of_phase("manipulation")
    hands = carried(grasp, recording.object_poses[frames])
    assert np.abs(pose_difference(hands, recording.hand_poses[frames])).max() < 1e-6


def test_the_hand_opens_and_goes_from_where_it_held() -> None:
    recording = DATABASE.recordings[1]
    held = turned_poses(
        recording.hand_poses[recording.of_phase("manipulation")[-1]], 0.7, [1, 0, 0]
    )
    path = release(GraspDatabase((recording,)), "tripod", held, 120.0)
    np.testing.assert_allclose(path[0], held, atol=1e-9)
    wanted = turned_poses(recording.hand_poses[recording.of_phase("releasing")], 0.7, [1, 0, 0])
    assert np.abs(pose_difference(path[-1], wanted[-1])).max() < 1e-6


@pytest.mark.parametrize("name", ["reaching", "manipulation", "releasing"])
def test_a_database_without_the_phase_is_refused(name: str) -> None:
    empty = GraspDatabase(())
    closing, pose = closing_elsewhere(), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=name):
        if name == "reaching":
            reach(empty, "tripod", None, closing, 60.0)
        elif name == "manipulation":
            transport(empty, pose, pose, 60.0)
        else:
            release(empty, "tripod", closing[-1], 60.0)


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="3 frames or more"):
        edited(np.zeros((2, 3)), first=np.zeros(3), last=np.zeros(3))
    with pytest.raises(InputError, match="an end has shape"):
        edited(wave(), first=np.zeros(2), last=np.zeros(3))
    with pytest.raises(InputError, match="closing has shape"):
        reach(DATABASE, "tripod", None, np.zeros((5, 7)), 60.0)
    with pytest.raises(InputError, match="target has shape"):
        transport(DATABASE, np.array([0, 0, 0, 1, 0, 0, 0.0]), np.zeros(3), 60.0)
    with pytest.raises(InputError, match="ends is"):
        EditWeights(ends=0.0)
