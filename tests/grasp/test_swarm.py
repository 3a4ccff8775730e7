"""The particle swarm, and how motions are placed about an object."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.swarm import (
    Cost,
    Swarm,
    SwarmConfig,
    draw_places,
    parts_of,
    place_motions,
    search,
)
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.transforms import rotvec_to_matrix


def test_a_swarm_finds_the_least_of_a_cost_with_many_hollows(rng: np.random.Generator) -> None:
    def cost(at: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        away = at - [0.7, -0.4, 0.2]
        return (away**2 - 0.1 * np.cos(9.0 * away) + 0.1).sum(1)

    config = SwarmConfig(particles=64, groups=4, generations=60)
    found = search([cost], rng.standard_normal((64, 3)), np.ones(3), config=config, rng=rng)
    np.testing.assert_allclose(found.positions[0], [0.7, -0.4, 0.2], atol=0.02)
    assert (np.diff(found.history) <= 0).all()
    assert (np.diff(found.costs) >= 0).all()
    np.testing.assert_array_equal(found.costs, cost(found.positions, found.costs))
    np.testing.assert_array_equal(np.sort(found.order), np.arange(64))


def test_groups_keep_to_hollows_of_their_own(rng: np.random.Generator) -> None:
    def cost(at: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        return np.minimum(((at - 3.0) ** 2).sum(1), ((at + 3.0) ** 2).sum(1) + 0.01)

    first = np.where(np.arange(40)[:, None] % 2 == 0, 3.0, -3.0) + 0.5 * rng.standard_normal(
        (40, 2)
    )
    config = SwarmConfig(particles=40, groups=2, generations=25)
    found = search([cost], first, np.full(2, 0.5), config=config, rng=rng)
    side = np.sign(found.positions[:, 0])
    np.testing.assert_array_equal(side, np.where(found.order % 2 == 0, 1.0, -1.0))


def bowl(at: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    return (at**2).sum(1)


def run(cost: Cost, threads: int, **settings: int) -> Swarm:
    """A search from seed 3; particles are shared unevenly among groups, groups among threads."""
    rng = np.random.default_rng(3)
    config = SwarmConfig(particles=17, groups=3, generations=6, **settings)
    first = rng.standard_normal((17, 4))
    return search([cost] * threads, first, np.ones(4), config=config, rng=rng)


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
def test_the_same_seed_gives_the_same_swarm_with_any_number_of_threads(threads: int) -> None:
    one, other = run(bowl, 1), run(bowl, threads)
    for name in ("positions", "costs", "order", "history"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_cost_that_is_no_lower_than_its_bound_need_not_be_known() -> None:
    given_up = []

    def hasty(at: np.ndarray, bounds: np.ndarray) -> np.ndarray:
        found = bowl(at, bounds)
        given_up.append((found >= bounds).sum())
        return np.where(found < bounds, found, np.inf)

    plain, quick = run(bowl, 1), run(hasty, 1)
    assert given_up[0] == 0
    assert sum(given_up) > 0
    np.testing.assert_array_equal(plain.positions, quick.positions)
    np.testing.assert_array_equal(plain.costs, quick.costs)


def test_parts_hold_whole_groups() -> None:
    config = SwarmConfig(particles=20, groups=3)
    for count in (1, 2, 3):
        parts = parts_of(config, count)
        assert len(parts) == count
        np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(20))
        groups = [set((part % 3).tolist()) for part in parts]
        assert sum(len(group) for group in groups) == 3
    assert len(parts_of(config, 8)) == 3


def test_a_placed_motion_is_the_motion_moved_as_one_body(rng: np.random.Generator) -> None:
    hand = HandModel.load().shaped()
    motions = np.zeros((2, 3, 28))
    motions[..., :3] = rng.normal(0.0, 0.1, (2, 3, 3))
    motions[..., 3:7] = rng.standard_normal((2, 3, 4))
    motions[..., 3:7] /= np.linalg.norm(motions[..., 3:7], axis=-1, keepdims=True)
    motions[..., 7:] = hand.rest_angles
    places = np.array([[0.0, 0.01, 0.02, 0.03, 0.0, 0.0], [0.5, 0.01, 0.0, 0.0, 0.2, -0.1]])
    upright = rotvec_to_matrix(np.array([0.3, -1.0, 0.4]))
    placed = keypoints(hand, place_motions(motions, places, upright))
    before = keypoints(hand, motions)
    np.testing.assert_allclose(placed[0], (before[0] + [0.01, 0.02, 0.03]) @ upright.T, atol=1e-12)
    tilt = rotvec_to_matrix(np.array([0.2, -0.1, 0.0]))
    turn = upright @ rotvec_to_matrix(np.array([0.0, 0.0, 0.5]))
    wanted = (before[1] @ tilt.T + [0.01, 0.0, 0.0]) @ turn.T
    np.testing.assert_allclose(placed[1], wanted, atol=1e-12)


def test_first_placements_come_from_the_wanted_side_or_from_all(rng: np.random.Generator) -> None:
    config = SwarmConfig()
    aimed = draw_places(400, 1.0, config=config, rng=rng)
    assert abs(aimed[:, 0].mean() - 1.0) < 0.15
    assert np.ptp(draw_places(400, None, config=config, rng=rng)[:, 0]) > 6.0
    assert config.log_prior(aimed).max() <= 0.0
    np.testing.assert_array_equal(config.log_prior(np.array([[2.0, 0, 0, 0, 0, 0]])), [0.0])


@pytest.mark.parametrize(
    "settings",
    [{"groups": 0}, {"groups": 9, "particles": 8}, {"generations": 0}, {"cognitive": 1.0},
     {"yaw_spread": 0.0}],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(InputError):
        SwarmConfig(**settings)  # type: ignore[arg-type]
