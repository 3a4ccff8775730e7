"""The test of dynamic feasibility: grasps whose forces are known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.feasibility import feasible

GRAVITY = 9.81


def pinch(width: float = 0.05, height: float = 0.0, angle: float = 0.0) -> tuple:
    """Two contacts on opposite sides of a block, the second's normal turned by an angle."""
    points = np.array([[0.5 * width, 0, height], [-0.5 * width, 0, height]])
    normals = np.array([[1.0, 0, 0], [-np.cos(angle), 0, np.sin(angle)]])
    return points, normals


def test_a_pinch_presses_as_hard_as_friction_needs() -> None:
    points, normals = pinch()
    found = feasible(points, normals, friction=0.5, mass=0.2)
    assert found.feasible
    # Two contacts carry m g together with friction 0.5: each presses with m g. An edge of the
    # pyramid may point sideways, which costs up to a factor of sqrt(2).
    assert 0.999 <= found.normal_forces.sum() / (2 * 0.2 * GRAVITY) <= np.sqrt(2) + 1e-6
    np.testing.assert_allclose(*found.normal_forces, rtol=1e-6)


def test_forces_are_in_balance_with_the_weight() -> None:
    # Three contacts around a cylinder, one from below: no friction is needed.
    points = np.array([[0, 0, -0.03], [0.03, 0, 0], [-0.03, 0, 0]])
    normals = points / 0.03
    found = feasible(points, normals, friction=0.0, mass=0.1)
    assert found.feasible
    np.testing.assert_allclose(found.normal_forces, [0.1 * GRAVITY, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("angle", "friction", "expected"),
    [(np.deg2rad(20), 0.8, True), (np.deg2rad(89), 0.4, False)],
    ids=["slightly tilted", "two adjacent sides of a cube"],
)
def test_pressing_on_adjacent_sides_does_not_hold(
    angle: float, friction: float, expected: bool
) -> None:
    points, normals = pinch(angle=angle)
    assert feasible(points, normals, friction=friction, mass=0.1).feasible is expected


def test_one_contact_from_above_holds_nothing() -> None:
    assert not feasible([[0, 0, 0.03]], [[0, 0, 1]], friction=1.0, mass=0.1).feasible
    assert not feasible(np.zeros((0, 3)), np.zeros((0, 3)), friction=1.0, mass=0.1).feasible


def test_contacts_far_from_the_centre_of_mass_hold_by_the_torque_of_their_patches() -> None:
    points, normals = pinch()
    beside = points + np.array([0, 0.05, 0])
    held = feasible(beside, normals, friction=0.8, mass=0.05, largest_force=None)
    weak = feasible(beside, normals, friction=0.8, mass=0.05, largest_force=20.0, patch_radius=1e-4)
    assert held.feasible
    assert not weak.feasible  # points without extent have no torque about their line
    centred = feasible(points, normals, friction=0.8, mass=0.05)
    assert held.normal_forces.sum() > 2 * centred.normal_forces.sum()


def test_what_is_too_heavy_for_the_fingers_is_not_feasible() -> None:
    points, normals = pinch()
    light = feasible(points, normals, friction=0.8, mass=1.0)
    heavy = feasible(points, normals, friction=0.8, mass=10.0)
    assert light.feasible
    assert not heavy.feasible
    assert np.isnan(heavy.normal_forces).all()
    assert feasible(points, normals, friction=0.8, mass=10.0, largest_force=None).feasible


def test_no_friction_holds_nothing_between_vertical_sides() -> None:
    points, normals = pinch()
    assert not feasible(points, normals, friction=0.0, mass=0.1).feasible


def test_unusable_input_is_refused() -> None:
    points, normals = pinch()
    with pytest.raises(InputError, match="mass is 0"):
        feasible(points, normals, friction=0.5, mass=0.0)
    with pytest.raises(InputError, match="friction -1"):
        feasible(points, normals, friction=-1, mass=0.1)
    with pytest.raises(InputError, match="shape"):
        feasible(points, normals[:1], friction=0.5, mass=0.1)


def test_more_friction_holds_whatever_less_friction_holds(rng: np.random.Generator) -> None:
    frictions, first = np.linspace(0.05, 1.2, 24), []
    for _ in range(12):
        normals = rng.standard_normal((4, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        held = np.array([
            feasible(0.03 * normals, normals, friction=mu, mass=0.1, largest_force=None).feasible
            for mu in frictions
        ])  # fmt: skip
        assert (np.diff(held.astype(int)) >= 0).all()
        first.append(frictions[held.argmax()] if held.any() else np.inf)
    assert len(set(first)) > 4  # it is the friction that decides
