"""The reference of every step: stages, pauses, and velocities that fit the positions."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.phases import PHASES
from handtrack.grasp.reference import Reference, Stage, reference
from handtrack.transforms import apply_increment, matrix_to_quat, rotvec_to_matrix


def sample(**changes) -> Reference:
    times = np.linspace(0.0, 1.9, 20)
    hands = np.zeros((20, 28))
    hands[:, 0] = 0.1 * times
    hands[:, 3:7] = matrix_to_quat(rotvec_to_matrix(np.outer(times, [0.0, 0.0, 0.5])))
    hands[:, 10] = 0.2 * times
    things = np.zeros((20, 7))
    things[:, 1], things[:, 3] = 0.3 * times, 1.0
    given = {
        "times": times, "hand_poses": hands, "object_poses": things,
        "phases": np.repeat(PHASES, 5), **changes,
    }  # fmt: skip
    return reference(
        given["times"], given["hand_poses"], given["object_poses"], given["phases"],
        timestep=0.001, take_time=0.2, hold_time=0.5,
    )  # fmt: skip


def test_stages_follow_each_other_and_pauses_last_as_asked() -> None:
    path = sample()
    assert (np.diff(path.stages) >= 0).all() and set(path.stages.tolist()) == set(Stage)
    assert (path.stages == Stage.TAKING).sum() == 200
    assert path.holding.sum() == 500
    for stage in (Stage.TAKING, Stage.HOLDING):
        still = path.hand_poses[path.stages == stage]
        np.testing.assert_array_equal(still, np.tile(still[0], (len(still), 1)))


def test_velocities_carry_each_step_to_the_next() -> None:
    path = sample()
    inner = np.flatnonzero(path.stages == Stage.CARRYING)[30:-30]
    ahead = apply_increment(path.hand_poses[inner], 0.001 * path.hand_velocities[inner])
    np.testing.assert_allclose(ahead, path.hand_poses[inner + 1], atol=1e-6)
    np.testing.assert_allclose(path.object_velocities[inner, 1], 0.3, atol=1e-6)


def test_frames_of_the_plan_are_met() -> None:
    path = sample()
    np.testing.assert_allclose(path.hand_poses[100, 0], 0.01, atol=1e-9)
    np.testing.assert_allclose(path.hand_poses[-1, 0], 0.19, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": np.zeros(20)}, "must rise"),
        ({"phases": np.repeat(PHASES[::-1], 5)}, "out of order"),
        ({"phases": np.repeat("waving", 20)}, "waving"),
        ({"object_poses": np.zeros((19, 7))}, "object poses of shape"),
    ],
)
def test_a_plan_that_does_not_fit_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        sample(**changes)
