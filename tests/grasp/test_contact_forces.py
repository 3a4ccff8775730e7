"""The contact force program: against the thesis's own form of it, and by mechanics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from handtrack.errors import InputError
from handtrack.grasp import contact_forces as module
from handtrack.grasp.contact_forces import ForceConfig, contact_forces, pyramid
from oracles.contact_forces import edges_of, objective, solve_by_edges

pytest.importorskip("daqp")

CONFIG = ForceConfig()

PINCH = np.array([[0.025, 0.0, 0.0], [-0.025, 0.0, 0.0]])
INTO = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
WEIGHT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def net(points, normals, forces, twists) -> np.ndarray:
    torque = np.cross(points, forces) + twists[:, None] * normals
    return np.concatenate([forces.sum(0), torque.sum(0)])


def test_edges_of_a_pyramid_lie_on_the_friction_cone(rng: np.random.Generator) -> None:
    normals = np.concatenate([rng.normal(size=(5, 3)), np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = pyramid(normals, 0.7, 6)
    along = np.einsum("kie,ki->ke", edges, normals)
    across = np.linalg.norm(edges - along[:, None] * normals[:, :, None], axis=1)
    np.testing.assert_allclose(along, 1.0)
    np.testing.assert_allclose(across, 0.7)
    wanted = np.stack([edges_of(normal, 0.7, 6) for normal in normals])
    np.testing.assert_allclose(edges, wanted, atol=1e-14)


def test_two_pads_carry_a_weight_inside_their_friction_cones() -> None:
    config = ForceConfig()
    forces, twists = contact_forces(PINCH, INTO, WEIGHT, friction=0.8, config=config)
    np.testing.assert_allclose(net(PINCH, INTO, forces, twists), WEIGHT, atol=0.01)
    press = np.einsum("ki,ki->k", forces, INTO)
    across = np.linalg.norm(forces - press[:, None] * INTO, axis=1)
    assert (press >= config.least_press - 1e-6).all()
    assert (across <= config.friction_share * 0.8 * press + 1e-6).all()


def test_torsion_stays_within_what_a_patch_can_twist() -> None:
    config = ForceConfig(torsion_radius=0.003)
    wanted = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    forces, twists = contact_forces(PINCH, INTO, wanted, friction=0.8, config=config)
    press = np.einsum("ki,ki->k", forces, INTO)
    assert (np.abs(twists) <= 0.003 * press + 1e-9).all()
    assert twists @ INTO[:, 0] > 0.0


def check_against_oracle(points, normals, wrench, friction, least, config=CONFIG) -> None:
    """The least objective, within what was allowed, and the forces it belongs to."""
    found = contact_forces(
        points, normals, wrench, friction=friction, least_press=least, config=config
    )
    wanted = solve_by_edges(points, normals, wrench, friction, least, config)
    reached, best = (objective(points, normals, wrench, *both, config) for both in (found, wanted))
    assert reached == pytest.approx(best, rel=1e-6, abs=1e-9)
    for got, want, within in zip(found, wanted, (1e-3, 2e-4), strict=True):
        np.testing.assert_allclose(got, want, atol=within)
    forces, twists = found
    press = np.einsum("ki,ki->k", forces, normals)
    assert (press >= least - 1e-5).all() and (press <= config.most_press + 1e-5).all()
    assert (np.abs(twists) <= config.torsion_radius * press + 1e-7).all()
    for force, normal in zip(forces, normals, strict=True):
        edges = edges_of(normal, config.friction_share * friction, config.cone_edges)
        assert nnls(edges, force)[1] < 1e-5


@pytest.mark.parametrize("count", range(1, 7))
def test_forces_are_those_of_the_thesis_program(count: int, rng: np.random.Generator) -> None:
    for _ in range(12):
        points = 0.04 * rng.normal(size=(count, 3))
        normals = rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        wrench = np.concatenate([2.0 * rng.normal(size=3), 0.05 * rng.normal(size=3)])
        least = rng.uniform(0.0, 2.0, count)
        check_against_oracle(points, normals, wrench, rng.uniform(0.2, 1.2), least)


@pytest.mark.parametrize("edges", [3, 4, 5, 8])
def test_any_number_of_edges_and_any_weights(edges: int, rng: np.random.Generator) -> None:
    config = ForceConfig(
        cone_edges=edges, force_weight=2.0, torque_weight=0.3, effort_weight=0.1,
        torsion_weight=0.05, torsion_radius=0.01, most_press=4.0, friction_share=1.0,
    )  # fmt: skip
    points = 0.03 * rng.normal(size=(4, 3))
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    wrench = np.concatenate([4.0 * rng.normal(size=3), 0.1 * rng.normal(size=3)])
    check_against_oracle(points, normals, wrench, 0.5, np.full(4, 0.3), config)


@pytest.mark.parametrize(
    ("points", "normals", "friction", "least"),
    [
        (PINCH[:1], INTO[:1], 0.8, 0.5),
        (PINCH, INTO, 0.8, 0.5),
        (PINCH, INTO[[0, 0]], 0.8, 0.5),
        (PINCH[[0, 0, 0]], INTO[[0, 0, 0]], 0.8, 0.5),
        (PINCH[[0, 0]], INTO, 0.8, 0.5),
        (0.0 * PINCH, INTO, 0.8, 0.5),
        (PINCH, INTO, 0.0, 0.5),
        (PINCH, INTO, 0.8, 0.0),
        (PINCH, INTO, 0.8, CONFIG.most_press),
    ],
    ids=[
        "one", "opposed", "parallel", "three in one", "opposed in one place", "at the centre",
        "without friction", "without a least force", "all pressed to the most",
    ],
)  # fmt: skip
@pytest.mark.parametrize("pull", [1.0, 1000.0])
def test_degenerate_contacts_are_solved_for(points, normals, friction, least, pull) -> None:
    wrench = pull * np.array([0.1, 0.2, 1.0, 0.01, 0.0, 0.02])
    check_against_oracle(points, normals, wrench, friction, np.full(len(points), least))


def test_a_patch_without_a_radius_does_not_twist() -> None:
    config = ForceConfig(torsion_radius=0.0)
    wanted = np.array([0.0, 0.0, 1.0, 0.1, 0.0, 0.0])
    forces, twists = contact_forces(PINCH, INTO, wanted, friction=0.8, config=config)
    assert not twists.any()
    np.testing.assert_allclose(forces.sum(0), wanted[:3], atol=0.01)


def test_a_bone_whose_contacts_cancel_out_gives_no_force() -> None:
    forces, twists = contact_forces(
        PINCH, INTO * [[0.0], [1.0]], WEIGHT, friction=0.8, config=CONFIG
    )
    assert np.abs(forces[0]).max() < 1e-6 and twists[0] == 0.0
    assert forces[1] @ INTO[1] >= CONFIG.least_press - 1e-6


def test_a_program_does_not_depend_on_those_before_it(rng: np.random.Generator) -> None:
    first = contact_forces(PINCH, INTO, WEIGHT, friction=0.8, least_press=3.0, config=CONFIG)
    for _ in range(3):
        contact_forces(PINCH, INTO, rng.normal(size=6), friction=0.8, config=CONFIG)
    again = contact_forces(PINCH, INTO, WEIGHT, friction=0.8, least_press=3.0, config=CONFIG)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_patches_press_straight_when_the_solver_gives_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "_solver", lambda: lambda *_: (np.zeros(8), 0.0, -1, {}))
    forces, twists = contact_forces(
        PINCH, INTO, WEIGHT, friction=0.8, least_press=[1.0, 2.0], config=CONFIG
    )
    np.testing.assert_array_equal(forces, INTO * [[1.0], [2.0]])
    assert not twists.any() and "DAQP flag -1" in caplog.text


def test_no_patch_gives_no_force() -> None:
    forces, twists = contact_forces(
        np.zeros((0, 3)), np.zeros((0, 3)), WEIGHT, friction=0.8, config=ForceConfig()
    )
    assert forces.shape == (0, 3) and twists.shape == (0,)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(InputError, match="cone_edges"):
        ForceConfig(cone_edges=2)
    with pytest.raises(InputError, match="smaller"):
        ForceConfig(least_press=3.0, most_press=2.0)
    with pytest.raises(InputError, match="torsion_radius"):
        ForceConfig(torsion_radius=-0.001)
    with pytest.raises(InputError, match=r"least_press is 25.0; expected at most 20.0"):
        contact_forces(PINCH, INTO, WEIGHT, friction=0.8, least_press=[1.0, 25.0], config=CONFIG)
