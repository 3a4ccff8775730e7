"""Skinning weights from quadratic forms: exact on small cases, and what handtrack can use."""

import numpy as np
import pytest
from scipy.optimize import minimize

from handtrack.hand.learning.weights import (
    WeightSupport,
    _best_on_simplex,
    dense_weights,
    learn_weights,
    slot_weights,
)
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import finger_of_bone


def test_best_weights_are_those_of_a_general_solver() -> None:
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((12, 4, 4))
    forms = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(4)
    pull = rng.standard_normal((12, 4))
    allowed = np.ones((12, 4), bool)
    allowed[:, 3] = False  # three bones are then no restriction
    best = _best_on_simplex(forms, pull, allowed)
    for form, p, found in zip(forms, pull, best, strict=True):
        form, p = form[:3, :3], p[:3]
        solved = minimize(
            lambda w, form=form, p=p: w @ form @ w - 2 * p @ w,
            np.full(3, 1 / 3),
            jac=lambda w, form=form, p=p: 2 * (form @ w - p),
            bounds=[(0, 1)] * 3,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
            options={"ftol": 1e-14},
            method="SLSQP",
        )
        np.testing.assert_allclose(found[:3], solved.x, atol=1e-5)
        assert found[3] == 0


def test_true_weights_come_back_where_the_forms_know_them(
    model: HandModel, blurred: HandModel
) -> None:
    support = WeightSupport.of(blurred)
    truth = dense_weights(model.weight_bones, model.weights)
    wanted = np.take_along_axis(truth, support.bones, axis=1)
    # Where weights sum to one, this form is the squared distance from the wanted ones.
    away = np.eye(4) - wanted[:, :, None]
    forms = 1e6 * (np.swapaxes(away, 1, 2) @ away)
    learnt = learn_weights(forms, support, support.first, model.faces, 0.05)
    reached = (support.allowed | (wanted == 0)).all(axis=1) & (np.abs(wanted.sum(1) - 1) < 1e-6)
    assert reached.mean() > 0.9
    assert np.abs(learnt - truth)[reached].max() < 0.01


def test_without_scans_the_first_weights_stay(blurred: HandModel) -> None:
    support = WeightSupport.of(blurred)
    nothing = np.zeros((len(support.bones), 4, 4))
    learnt = learn_weights(nothing, support, support.first, blurred.faces, 0.05)
    np.testing.assert_allclose(learnt, support.first, atol=1e-7)


def test_learnt_weights_are_what_a_hand_model_may_hold(blurred: HandModel) -> None:
    rng = np.random.default_rng(5)
    support = WeightSupport.of(blurred)
    roots = 30.0 * rng.standard_normal((len(support.bones), 4, 2))
    forms = roots @ np.swapaxes(roots, 1, 2)
    learnt = learn_weights(forms, support, support.first, blurred.faces, 0.05)
    assert learnt.min() >= 0
    np.testing.assert_allclose(learnt.sum(axis=1), 1.0, atol=1e-9)
    assert (np.count_nonzero(learnt, axis=1) <= 3).all()
    moved = [{finger_of_bone(int(b)) for b in np.flatnonzero(row) if b} for row in learnt]
    assert max(map(len, moved)) == 1
    bones, weights = slot_weights(learnt)
    np.testing.assert_allclose(dense_weights(bones, weights), learnt, atol=1e-12)
    assert np.abs(learnt - support.first).max() > 0.1


def test_bones_stay_near_what_they_moved_at_first(model: HandModel) -> None:
    support = WeightSupport.of(model)
    assert support.allowed.any(axis=1).all()
    # The tip of the index finger never moves with the palm.
    tip = int(model.vertices[:, 0].argmax())
    assert not support.allowed[tip, 0]
    assert support.allowed.mean() < 0.75
    assert support.allowed.sum(axis=1).mean() == pytest.approx(2.4, abs=0.8)
