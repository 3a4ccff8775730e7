"""The shape fitted to rendered images: recovery, certainty, and the equations behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.fitting.shape_config import ShapeFitConfig
from handtrack.fitting.shape_fitter import ShapeFitter
from handtrack.fitting.shape_system import ShapeEquations
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.subjects import UnseenSubjects
from handtrack.transforms import apply_increment
from oracles.scenes import SMALL_CAMERA, hand_model, seen_poses

Float = NDArray[np.float64]

CONFIG = ShapeFitConfig(fit=replace(ShapeFitConfig().fit, crop_cells=64))
"""The default settings on a coarser crop."""


@dataclass(frozen=True)
class Images:
    hand: ShapedHand
    depths: NDArray[np.float32]
    poses: Float
    starts: Float


def images_of(side: str, count: int = 4, number: int = 12) -> Images:
    """Images of a subject that the model has not seen, near the camera."""
    rng = np.random.default_rng(7)
    hand = UnseenSubjects.load().hand(number, hand_model(), side=side)
    poses = seen_poses(hand, rng, count, distance=0.3, turn=0.3, bend=0.25)
    depths = DepthRenderer(hand, SMALL_CAMERA, device="cpu", batch=4).render(poses)
    noise = np.repeat([0.004, 0.04, 0.06], [3, 3, 21])
    starts = apply_increment(poses, noise * rng.uniform(-1, 1, (count, 27)))
    return Images(hand, depths, poses, starts)


def bone_error(fitter: ShapeFitter, x: Float, truth: ShapedHand) -> float:
    """Mean error of bone lengths [mm]."""
    return 1e3 * float(np.abs(fitter.unknowns.hand(x).bone_lengths - truth.bone_lengths).mean())


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_shape_of_an_unseen_hand_is_found(device, side) -> None:
    seen = images_of(side)
    fitter = ShapeFitter(
        hand_model(), SMALL_CAMERA, images=4, side=side, config=CONFIG, device=device
    )
    fit = fitter.run(seen.depths, seen.starts)
    before = bone_error(fitter, np.zeros_like(fit.unknowns), seen.hand)
    assert fit.converged and fit.rounds < CONFIG.rounds
    assert before > 2.0  # otherwise the subject shows nothing
    assert bone_error(fitter, fit.unknowns, seen.hand) < 1.3
    mean = fitter.run(seen.depths, seen.starts, rounds=0)
    assert mean.rounds == 0 and not mean.unknowns.any()
    assert fit.errors.mean() < 0.8 * mean.errors.mean()


def test_an_image_without_weight_changes_nothing(device) -> None:
    seen = images_of("right")
    fitter = ShapeFitter(hand_model(), SMALL_CAMERA, images=4, config=CONFIG, device=device)
    spoilt = seen.depths.copy()
    spoilt[3] = np.where(spoilt[3] > 0, spoilt[3] + 0.01, 0)[:, ::-1]
    counts = np.array([1.0, 1.0, 1.0, 0.0])
    first = fitter.run(seen.depths, seen.starts, weights=counts)
    second = fitter.run(spoilt, seen.starts, weights=counts)
    np.testing.assert_array_equal(first.unknowns, second.unknowns)
    third = fitter.run(spoilt, seen.starts)
    assert np.abs(third.unknowns - first.unknowns).max() > 0.05


def test_more_images_make_surer_and_none_leave_the_prior(device) -> None:
    seen = images_of("right")
    fitter = ShapeFitter(hand_model(), SMALL_CAMERA, images=4, config=CONFIG, device=device)
    fit = fitter.run(seen.depths, seen.starts)
    every = fit.certainty(fitter.unknowns)
    two = fit.certainty(fitter.unknowns, [0, 1])
    nothing = fit.certainty(fitter.unknowns, [])
    assert (every.deviations <= two.deviations).all()
    assert every.lengths.mean() < two.lengths.mean() < nothing.lengths.mean()
    np.testing.assert_allclose(nothing.lengths, nothing.prior_lengths)
    assert every.problem is None
    assert nothing.problem is not None and "any finger" in nothing.problem


def test_holding_the_poses_still_lags_behind(device) -> None:
    seen = images_of("right")
    found = []
    for follow in (True, False):
        config = replace(CONFIG, follow_poses=follow)
        fitter = ShapeFitter(hand_model(), SMALL_CAMERA, images=4, config=config, device=device)
        fit = fitter.run(seen.depths, seen.starts, rounds=6)
        found.append(bone_error(fitter, fit.unknowns, seen.hand))
    assert found[0] < found[1]


def test_reduced_equations_are_those_of_the_whole_system(rng) -> None:
    shape, pose, rows = 4, 27, 2
    jacobian = rng.standard_normal((rows, 80, pose + shape))
    residual = rng.standard_normal((rows, 80))
    whole = np.einsum("rni,rnj->rij", jacobian, jacobian)
    right = np.einsum("rni,rn->ri", jacobian, residual)
    equations = ShapeEquations(
        poses=whole[:, :pose, :pose], pose_gradients=right[:, :pose],
        shapes=whole[:, pose:, pose:], shape_gradients=right[:, pose:],
        mixed=whole[:, pose:, :pose],
    )  # fmt: skip
    floor = np.full(pose, 0.1)
    matrices, gradients = equations.reduced(floor)
    step = -np.linalg.solve(matrices.sum(0), gradients.sum(0))
    turns = equations.pose_steps(floor, step)
    # All unknowns at once.
    size = rows * pose + shape
    full, gradient = np.zeros((size, size)), np.zeros(size)
    for row in range(rows):
        own = np.r_[row * pose : (row + 1) * pose, rows * pose : size]
        full[np.ix_(own, own)] += whole[row]
        gradient[own] += right[row]
    full[range(rows * pose), range(rows * pose)] += 0.1
    expected = -np.linalg.solve(full, gradient)
    np.testing.assert_allclose(step, expected[rows * pose :], atol=1e-9)
    np.testing.assert_allclose(turns.ravel(), expected[: rows * pose], atol=1e-9)


def test_impossible_arguments_are_refused(device) -> None:
    fitter = ShapeFitter(hand_model(), SMALL_CAMERA, images=2, config=CONFIG, device=device)
    with pytest.raises(InputError, match="poses have shape"):
        fitter.run(np.zeros((2, 120, 160), np.float32), np.zeros((3, 28)))
    with pytest.raises(InputError, match=r"ShapeFitConfig\.prior_weight"):
        ShapeFitConfig(prior_weight=0.0)
