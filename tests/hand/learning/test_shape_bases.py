"""PCA of subjects."""

from dataclasses import replace

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.learning.posed_template import SubjectShape, Template
from handtrack.hand.learning.shape_bases import learn_bases
from handtrack.hand.shape import HandShape


def shapes_of(template: Template, count: int) -> list[SubjectShape]:
    rng = np.random.default_rng(0)
    pattern = rng.standard_normal(template.model.vertices.shape)
    shapes = []
    for _ in range(count):
        size, thick = 1 + 0.05 * rng.standard_normal(), 0.001 * rng.standard_normal()
        shapes.append(replace(template.shape(size), offsets=thick * pattern))
    return shapes


def test_two_ways_of_varying_give_one_component_each(template: Template) -> None:
    shapes = shapes_of(template, 30)
    bases = learn_bases(template, shapes, 0.98)
    assert bases.scale_basis.shape == (17, 1)
    assert bases.offset_basis.shape[2] == 1
    assert bases.scale_variance.sum() > 0.999
    sizes = np.array([template.overall(s) for s in shapes])
    assert bases.scale_mean[0] == pytest.approx(sizes.mean())
    assert abs(bases.scale_basis[0, 0]) == pytest.approx(sizes.std(ddof=1))


def test_the_model_reproduces_a_subject_by_its_coordinates(template: Template) -> None:
    shapes = shapes_of(template, 30)
    bases = learn_bases(template, shapes, 0.98)
    away = template.overall(shapes[0]) - bases.scale_mean[0]
    alpha = away / bases.scale_basis[0, 0]
    flat = (shapes[0].all_offsets - bases.offset_mean).ravel()
    basis = bases.offset_basis.reshape(-1, 1)
    beta = np.linalg.lstsq(basis, flat, rcond=None)[0]
    hand = bases.model(template).shaped(HandShape(alpha=np.array([alpha]), beta=beta))
    own = template.hand(shapes[0])
    np.testing.assert_allclose(hand.local_vertices, own.local_vertices, atol=1e-9)


def test_one_subject_is_no_space(template: Template) -> None:
    with pytest.raises(InputError, match="two subjects"):
        learn_bases(template, [template.shape()], 0.98)
