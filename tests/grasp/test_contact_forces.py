"""The contact force program: against SciPy's solver, and what it must give by mechanics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from handtrack.errors import InputError
from handtrack.grasp.contact_forces import ForceConfig, contact_forces, pyramid

pytest.importorskip("daqp")

PINCH = np.array([[0.025, 0.0, 0.0], [-0.025, 0.0, 0.0]])
INTO = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
WEIGHT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def net(points, normals, forces, twists) -> np.ndarray:
    torque = np.cross(points, forces) + twists[:, None] * normals
    return np.concatenate([forces.sum(0), torque.sum(0)])


def test_edges_of_a_pyramid_lie_on_the_friction_cone(rng: np.random.Generator) -> None:
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = pyramid(normals, 0.7, 6)
    along = np.einsum("kie,ki->ke", edges, normals)
    across = np.linalg.norm(edges - along[:, None] * normals[:, :, None], axis=1)
    np.testing.assert_allclose(along, 1.0)
    np.testing.assert_allclose(across, 0.7)


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


def test_program_equals_scipys_solution(rng: np.random.Generator) -> None:
    config = ForceConfig(cone_edges=4, least_press=0.2, most_press=5.0)
    points = 0.03 * rng.normal(size=(3, 3))
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    wrench = np.concatenate([rng.normal(size=3), 0.02 * rng.normal(size=3)])
    forces, twists = contact_forces(points, normals, wrench, friction=0.6, config=config)
    basis = pyramid(normals, 0.6 * config.friction_share, 4)
    size = np.linalg.norm(points, axis=1).mean()

    def unpack(x):
        return np.einsum("kie,ke->ki", basis, x[:12].reshape(3, 4)), size * x[12:]

    def cost(x):
        f, twist = unpack(x)
        miss = net(points, normals, f, twist) - wrench
        return (
            config.force_weight * miss[:3] @ miss[:3]
            + config.torque_weight * miss[3:] @ miss[3:] / size**2
            + config.effort_weight * (f**2).sum()
            + config.torsion_weight * (twist**2).sum() / size**2
        )

    def press(x):
        return x[:12].reshape(3, 4).sum(1)

    radius = config.torsion_radius / size
    limits = [
        {"type": "ineq", "fun": lambda x: press(x) - 0.2},
        {"type": "ineq", "fun": lambda x: 5.0 - press(x)},
        {"type": "ineq", "fun": lambda x: radius * press(x) - x[12:]},
        {"type": "ineq", "fun": lambda x: radius * press(x) + x[12:]},
    ]
    best = minimize(
        cost, np.full(15, 0.1), method="SLSQP", constraints=limits,
        bounds=[(0, None)] * 12 + [(None, None)] * 3, options={"maxiter": 500, "ftol": 1e-14},
    )  # fmt: skip
    wanted = unpack(best.x)
    np.testing.assert_allclose(forces, wanted[0], atol=2e-3)
    np.testing.assert_allclose(twists, wanted[1], atol=2e-4)


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
