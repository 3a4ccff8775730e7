"""Fitting a shape space to scans of people outside it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.learning.posed_template import PosedTemplate, Template
from handtrack.hand.learning.space_fit import _by_coordinates, _subject_shape, fit_in_space
from handtrack.hand.learning.subject import start_subject
from handtrack.hand.model import HandModel


def test_derivative_by_coordinates_agrees_with_central_differences(
    model: HandModel, template: Template
) -> None:
    rng = np.random.default_rng(0)
    at = rng.standard_normal(model.nalpha + model.nbeta)
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], rng.uniform(*model.limits.T)])

    def posed(coordinates: NDArray) -> PosedTemplate:
        return PosedTemplate(template, _subject_shape(model, coordinates), pose[None])

    steps = 1e-6 * np.eye(len(at))
    expected = np.stack(
        [(posed(at + s).vertices - posed(at - s).vertices) / 2e-6 for s in steps], axis=-1
    )
    derivative = _by_coordinates(model, posed(at), at)
    np.testing.assert_allclose(derivative, expected, atol=1e-8)


def test_a_person_of_the_space_is_met_far_better_than_the_mean_hand(
    model: HandModel, template: Template, poses: dict[str, NDArray], scan_of: Callable
) -> None:
    shape = model.sample_shape(np.random.default_rng(11))
    made = scan_of(shape, "bent", 5)
    scans = [made.scan()]
    start = start_subject(template, scans, poses["bent"][None])

    def away(*, free_shape: bool) -> float:
        fit = fit_in_space(model, scans, start.poses, steps=10, free_shape=free_shape)
        return float(made.away(fit.vertices[0]).mean())

    fitted = away(free_shape=True)
    assert fitted < 0.0004
    assert fitted < 0.3 * away(free_shape=False)
