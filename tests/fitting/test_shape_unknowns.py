"""Unknowns of the shape: round trips, and derivatives against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.hand.shape import HandShape
from oracles.scenes import hand_model

STEP = 1e-5


def test_a_shape_comes_back_from_its_unknowns(rng) -> None:
    unknowns = ShapeUnknowns(hand_model())
    shape = HandShape(scale=1.1, alpha=rng.standard_normal(3), beta=rng.standard_normal(2))
    back = unknowns.shape(unknowns.vector(shape))
    assert back.scale == pytest.approx(1.1)
    np.testing.assert_allclose(back.alpha[:3], shape.alpha)
    np.testing.assert_allclose(back.beta[:2], shape.beta)
    assert not back.alpha[3:].any() and not back.beta[2:].any()


@pytest.mark.parametrize("side", ["right", "left"])
def test_steps_equal_central_differences(rng, side) -> None:
    unknowns = ShapeUnknowns(hand_model(), side=side)
    x = 0.7 * rng.standard_normal(unknowns.count)
    x[0] *= 0.1
    steps, lengths = unknowns.steps(x), unknowns.length_steps(x)
    for unknown in range(unknowns.count):
        move = np.zeros(unknowns.count)
        move[unknown] = STEP
        ahead, behind = unknowns.hand(x + move), unknowns.hand(x - move)
        for found, name in (
            (steps.vertices[:, :, unknown], "local_vertices"),
            (steps.joints[:, unknown], "bone_origins"),
            (steps.tips[:, unknown], "tip_offsets"),
            (lengths[:, unknown], "bone_lengths"),
        ):
            expected = (getattr(ahead, name) - getattr(behind, name)) / (2 * STEP)
            np.testing.assert_allclose(found, expected, atol=1e-8)


def test_deviations_go_with_the_shape(rng) -> None:
    unknowns = ShapeUnknowns(hand_model())
    told = rng.uniform(0.1, 1.0, unknowns.count)
    shape = unknowns.with_deviations(HandShape(scale=2.0, **{
        "alpha": np.zeros(hand_model().nalpha), "beta": np.zeros(hand_model().nbeta)
    }), told)  # fmt: skip
    assert shape.scale_std == pytest.approx(2.0 * told[0])
    np.testing.assert_array_equal(np.concatenate([shape.alpha_std, shape.beta_std]), told[1:])
