"""Terms without the image: energies, gradients as half their slope, Gauss-Newton matrices."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.fitting.spheres import CollisionSpheres
from handtrack.hand.skeleton import ANGLE_BONES, NANGLE
from handtrack.kernels import priors
from handtrack.transforms import apply_increment
from oracles.device_arrays import download, poisoned, upload
from oracles.energy import NV, Spheres, differences, gaussian, limits, smoothness
from oracles.scenes import rounded

Float = NDArray[np.float64]

RELATIVE = 2e-4
"""Float32 energies and gradients of a few dozen terms."""
NCOST = NV + 9
FIRST = 4


def random_prior(rng: np.random.Generator) -> tuple[Float, Float]:
    """Mean and precision of joint angles."""
    factor = rng.standard_normal((NANGLE, 40))
    return rounded(rng.uniform(-0.2, 0.8, NANGLE)), rounded(factor @ factor.T / 10)


def run_pose_terms(
    posed, device: str, rng: np.random.Generator, reference: Float, *, prior: tuple[Float, Float],
    limit_weight: float, prior_weight: float, smooth: Float,
) -> tuple[Float, Float, Float, Float]:  # fmt: skip
    """Added hessian, added gradient, costs, and the limits used."""
    bounds = rounded(posed.hands[0].limits)
    nrow = posed.nrow
    base_hessian = rounded(rng.standard_normal((nrow, NV, NV)))
    base_gradient = rounded(rng.standard_normal((nrow, NV)))
    hessian, gradient = upload(base_hessian, device), upload(base_gradient, device)
    costs = poisoned((nrow, NCOST), device)
    priors.add_pose_terms(
        upload(bounds, device), upload(prior[0], device), upload(prior[1], device), posed.rows,
        posed.pose, upload(reference, device), upload(smooth, device),
        limit_weight=limit_weight, prior_weight=prior_weight, first_cost=FIRST,
        hessian=hessian, gradient=gradient, costs=costs,
    )  # fmt: skip
    found = download(costs)
    # Other terms' slots stay as they are.
    assert np.isnan(found[:, :FIRST]).all() and np.isnan(found[:, FIRST + NV :]).all()
    return (
        download(hessian) - base_hessian, download(gradient) - base_gradient,
        found[:, FIRST : FIRST + NV], bounds,
    )  # fmt: skip


CASES = {
    "smoothness": (1.0, 0.0, 0.0),
    "limits": (0.0, 50.0, 0.0),
    "prior": (0.0, 0.0, 0.7),
    "all": (1.0, 50.0, 0.7),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("side", ["right", "left"])
def test_pose_terms_equal_the_energies(make_posed, device, rng, side, case) -> None:
    smooth_scale, limit_weight, prior_weight = CASES[case]
    posed = make_posed(device, side=side, seed=41, bend=1.0)
    # Some angles beyond their limits, on both ends.
    poses = posed.poses.copy()
    poses[:, 7:] += rng.uniform(-0.9, 0.9, (posed.nrow, NANGLE))
    poses = rounded(poses)
    posed.pose.assign(poses.astype(np.float32))
    reference = rounded(apply_increment(poses, 0.1 * rng.standard_normal((posed.nrow, NV))))
    smooth = rounded(smooth_scale * rng.uniform(0.5, 3.0, (2, NV)))
    # One weight for all three axes of rotation: then the gradient is exact for turns of any size.
    smooth[:, 4:6] = smooth[:, 3:4]
    prior = random_prior(rng)
    hessian, gradient, costs, bounds = run_pose_terms(
        posed, device, rng, reference, prior=prior, limit_weight=limit_weight,
        prior_weight=prior_weight, smooth=smooth,
    )  # fmt: skip
    for row, hand in enumerate(posed.row_hand):

        def energy(pose: Float, row=row, hand=hand) -> np.float64:
            return np.float64(
                smoothness(pose, reference[row], smooth[hand])
                + limits(pose[7:], bounds, limit_weight)
                + gaussian(pose[7:], *prior, prior_weight)
            )

        total = energy(poses[row])
        assert total > 0
        assert costs[row].sum() == pytest.approx(total, rel=RELATIVE)
        slope = differences(energy, poses[row])
        np.testing.assert_allclose(
            gradient[row], slope / 2, atol=RELATIVE * np.abs(slope).max() + 1e-6
        )
        over = (poses[row, 7:] < bounds[:, 0]) | (poses[row, 7:] > bounds[:, 1])
        assert over.any() and not over.all()
        expected = np.diag(smooth[hand])
        expected[6:, 6:] += np.diag(limit_weight * over) + prior_weight * prior[1]
        np.testing.assert_allclose(hessian[row], expected, atol=RELATIVE * np.abs(expected).max())


def test_nothing_pulls_where_everything_is_satisfied(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=42, bend=0.5)
    # The prior's mean at the pose, the reference equal to it, all angles within limits.
    posed.poses[:, 7:] = posed.poses[0, 7:]
    posed.pose.assign(posed.poses.astype(np.float32))
    mean = posed.poses[0, 7:]
    _, gradient, costs, _ = run_pose_terms(
        posed, device, rng, posed.poses, prior=(mean, random_prior(rng)[1]), limit_weight=1000.0,
        prior_weight=1.0, smooth=np.ones((2, NV)),
    )  # fmt: skip
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)
    np.testing.assert_allclose(costs, 0.0, atol=1e-9)


@pytest.mark.parametrize("angle", [1e-7, 1e-4, 0.5, 2.0, 3.0])
def test_smoothness_of_the_rotation_is_its_angle(make_posed, device, rng, angle) -> None:
    posed = make_posed(device, seed=43)
    axis = rng.standard_normal((posed.nrow, 3))
    turn = np.zeros((posed.nrow, NV))
    turn[:, 3:6] = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    reference = apply_increment(posed.poses, -turn)
    smooth = np.zeros((2, NV))
    smooth[:, 3:6] = 1.0
    _, gradient, costs, _ = run_pose_terms(
        posed, device, rng, reference, prior=random_prior(rng), limit_weight=0.0,
        prior_weight=0.0, smooth=smooth,
    )  # fmt: skip
    np.testing.assert_allclose(np.sqrt(costs.sum(1)), angle, atol=1e-5)
    # Turning by w about the reference, the energy grows along w.
    np.testing.assert_allclose(gradient[:, 3:6], turn[:, 3:6], atol=2e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_quaternion_and_its_negative_are_the_same_reference(
    make_posed, device, rng, sign
) -> None:
    posed = make_posed(device, seed=44)
    reference = posed.poses.copy()
    reference[:, 3:7] *= sign
    _, gradient, costs, _ = run_pose_terms(
        posed, device, rng, reference, prior=random_prior(rng), limit_weight=0.0,
        prior_weight=0.0, smooth=np.ones((2, NV)),
    )  # fmt: skip
    np.testing.assert_allclose(costs, 0.0, atol=1e-9)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)


def run_collisions(
    posed, device: str, rng: np.random.Generator, spheres: CollisionSpheres, weight: float
) -> tuple[Float, Float, Float, Float]:
    """Added hessian, added gradient, the costs' slot, and the centres."""
    nrow, slot = posed.nrow, 3
    base_hessian = rounded(rng.standard_normal((nrow, NV, NV)))
    base_gradient = rounded(rng.standard_normal((nrow, NV)))
    hessian, gradient = upload(base_hessian, device), upload(base_gradient, device)
    costs = poisoned((nrow, 6), device)
    centres = poisoned((nrow, spheres.count), device, wp.vec3)
    priors.add_collisions(
        spheres.bones, spheres.centres, spheres.radii, spheres.pairs,
        upload(np.array(ANGLE_BONES), device), posed.rows, posed.rotations, posed.origins,
        posed.axes, weight=weight, cost_slot=slot,
        centres=centres, hessian=hessian, gradient=gradient, costs=costs,
    )  # fmt: skip
    found = download(costs)
    assert np.isnan(np.delete(found, slot, 1)).all()
    return (
        download(hessian) - base_hessian, download(gradient) - base_gradient, found[:, slot],
        download(centres),
    )  # fmt: skip


@pytest.mark.parametrize("side", ["right", "left"])
def test_collisions_equal_the_energy(make_posed, device, rng, side) -> None:
    posed = make_posed(device, side=side, seed=45, bend=1.0)
    built = CollisionSpheres.build(posed.hands, wp.get_device(device))
    weight = 1.0e4
    # Thicker fingers than any: many overlaps.
    radii = rounded(1.4 * built.radii.numpy())
    built.radii.assign(radii.astype(np.float32))
    hessian, gradient, costs, centres = run_collisions(posed, device, rng, built, weight)
    bones, local, pairs = built.bones.numpy(), download(built.centres), built.pairs.numpy()
    for row, number in enumerate(posed.row_hand):
        hand, pose = posed.hands[number], posed.poses[row]
        spheres = Spheres(hand, bones, local[number], radii[number], pairs)
        overlaps = spheres.overlaps(pose)
        assert (overlaps > 0).sum() > 10
        energy = spheres.energy(pose, weight)
        assert costs[row] == pytest.approx(energy, rel=1e-3)
        slope = differences(lambda q, s=spheres: np.float64(s.energy(q, weight)), pose)
        np.testing.assert_allclose(gradient[row], slope / 2, atol=1e-3 * np.abs(slope).max())
        active = overlaps > 0
        jacobian = -differences(spheres.distances, pose)[active]
        np.testing.assert_allclose(
            hessian[row], weight * jacobian.T @ jacobian,
            atol=1e-3 * weight * np.abs(jacobian).max() ** 2,
        )  # fmt: skip
        # Moving the whole hand parts no fingers.
        np.testing.assert_allclose(gradient[row, :6], 0.0, atol=1e-6 * weight)
        placed = np.linalg.norm(centres[row][pairs[:, 0]] - centres[row][pairs[:, 1]], axis=1)
        np.testing.assert_allclose(placed, spheres.distances(pose), atol=2e-6)


def test_fingers_apart_do_not_collide(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=46, bend=0.0)
    built = CollisionSpheres.build(posed.hands, wp.get_device(device))
    built.radii.assign(0.1 * built.radii.numpy())
    hessian, gradient, costs, _ = run_collisions(posed, device, rng, built, 1.0e4)
    np.testing.assert_array_equal(costs, 0.0)
    np.testing.assert_array_equal(hessian, 0.0)
    np.testing.assert_array_equal(gradient, 0.0)


def test_spheres_in_one_place_do_not_give_nan(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=47)
    built = CollisionSpheres.build(posed.hands, wp.get_device(device))
    # All bones in one frame and all centres at its origin: no direction to push along.
    built.centres.assign(np.zeros_like(built.centres.numpy()))
    posed.origins.assign(np.zeros_like(posed.origins.numpy()))
    hessian, gradient, costs, _ = run_collisions(posed, device, rng, built, 1.0e4)
    assert np.isfinite(hessian).all() and np.isfinite(gradient).all() and np.isfinite(costs).all()
