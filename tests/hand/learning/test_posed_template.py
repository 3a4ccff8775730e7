"""Derivatives of the template against central differences, and against the hand model itself."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.learning.posed_template import PosedTemplate, SubjectShape, Template
from handtrack.hand.model import HandModel
from handtrack.transforms import apply_increment

STEP = 1e-6


@pytest.fixture(scope="module")
def shape(template: Template) -> SubjectShape:
    rng = np.random.default_rng(0)
    plain = template.shape(1.1)
    return SubjectShape(
        stretches=plain.stretches * (1 + 0.05 * rng.standard_normal(16)),
        joints=0.003 * rng.standard_normal((5, 3)),
        offsets=0.001 * rng.standard_normal(plain.offsets.shape),
    )


@pytest.fixture(scope="module")
def poses(model: HandModel) -> NDArray[np.float64]:
    rng = np.random.default_rng(1)
    turns = rng.standard_normal((2, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    angles = rng.uniform(*model.limits.T, (2, 21))
    return np.hstack([rng.standard_normal((2, 3)), turns, angles])


def differences(moved: Callable[[NDArray], NDArray], count: int) -> NDArray[np.float64]:
    directions = STEP * np.eye(count)
    return np.stack([(moved(d) - moved(-d)) / (2 * STEP) for d in directions], axis=-1)


def test_vertices_are_those_of_the_hand_model(
    model: HandModel, template: Template, shape: SubjectShape, poses: NDArray
) -> None:
    exact = replace(
        model,
        scale_mean=template.scales(shape),
        offset_mean=shape.all_offsets,
        scale_basis=np.zeros((17, 0)),
        offset_basis=np.zeros((len(model.vertices) + 5, 3, 0)),
    )
    posed = PosedTemplate(template, shape, poses)
    np.testing.assert_allclose(posed.vertices, skin(exact.shaped(), poses), atol=1e-12)


@pytest.mark.parametrize("by", ["pose", "stretches", "joints", "offsets"])
def test_derivatives_agree_with_central_differences(
    template: Template, shape: SubjectShape, poses: NDArray, by: str
) -> None:
    def moved(d: NDArray) -> NDArray:
        if by == "pose":
            return PosedTemplate(template, shape, apply_increment(poses, d)).vertices
        value = getattr(shape, by)
        step = d.reshape(value.shape) if by != "offsets" else d
        return PosedTemplate(template, replace(shape, **{by: value + step}), poses).vertices

    count = {"pose": 27, "stretches": 16, "joints": 15, "offsets": 3}[by]
    derivative = getattr(PosedTemplate(template, shape, poses), f"by_{by}")()
    np.testing.assert_allclose(derivative, differences(moved, count), atol=1e-8)


def test_single_bones_blended_by_the_weights_give_the_vertices(
    model: HandModel, template: Template, shape: SubjectShape, poses: NDArray
) -> None:
    posed = PosedTemplate(template, shape, poses)
    placed = posed.by_weights(model.weight_bones.astype(np.intp))
    blended = np.einsum("vk,tvki->tvi", model.weights, placed)
    np.testing.assert_allclose(blended, posed.vertices, atol=1e-12)


def test_overall_scale_and_bone_scales_share_out_the_stretches(
    template: Template, shape: SubjectShape
) -> None:
    scales = template.scales(shape)
    np.testing.assert_allclose(scales[0] * scales[1:], shape.stretches, rtol=1e-12)
    assert scales[1:] @ template.lengths == pytest.approx(template.lengths.sum())
