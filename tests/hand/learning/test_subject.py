"""One subject: from scans that lie anywhere to its surface."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.learning.options import LearningOptions
from handtrack.hand.learning.posed_template import PosedTemplate, Template
from handtrack.hand.learning.scans import Scan
from handtrack.hand.learning.subject import (
    PopulationMean,
    SubjectFitter,
    neighbour_laplacian,
    start_subject,
)
from handtrack.hand.learning.weights import WeightSupport
from handtrack.hand.model import HandModel


@pytest.fixture(scope="module")
def mean(template: Template) -> PopulationMean:
    return PopulationMean.of(template, [template.shape()])


def test_unregistered_scans_give_the_surface(
    model: HandModel,
    template: Template,
    mean: PopulationMean,
    poses: dict[str, NDArray],
    scan_of: Callable,
) -> None:
    shape = model.sample_shape(np.random.default_rng(3))
    made = [scan_of(shape, pose, seed) for seed, pose in enumerate(("rest", "bent"))]
    scans = [one.scan() for one in made]
    angles = np.array([poses["rest"], poses["bent"]])
    fitter = SubjectFitter(template, scans, angles, mean, LearningOptions(first_steps=10))
    begun = fitter.begin(start_subject(template, scans, angles))
    fit = fitter.improve(begun, 4)
    fitted = PosedTemplate(template, fit.shape, fit.poses).vertices
    for vertices, truth in zip(fitted, made, strict=True):
        away = truth.away(vertices)
        assert away.mean() < 0.0004
        assert np.quantile(away, 0.95) < 0.0012
    assert fit.residuals[-1] < 0.5 * begun.residuals[0]
    assert fit.matched > 0.7
    assert not fit.astray.any()


def test_registered_scan_of_one_pose_is_met_exactly(
    model: HandModel, template: Template, mean: PopulationMean, poses: dict[str, NDArray]
) -> None:
    hand = model.shaped(model.sample_shape(np.random.default_rng(4)))
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], poses["rest"]])
    vertices = skin(hand, pose)
    mesh = trimesh.Trimesh(vertices, model.faces, process=False)
    scans = [Scan.of_mesh(mesh, subject="a", pose="rest", template_faces=model.faces)]
    angles = poses["rest"][None]
    fitter = SubjectFitter(template, scans, angles, mean, LearningOptions(first_steps=6))
    fit = fitter.improve(fitter.begin(start_subject(template, scans, angles)), 3)
    fitted = PosedTemplate(template, fit.shape, fit.poses).vertices[0]
    assert np.linalg.norm(fitted - vertices, axis=1).mean() < 0.0002


def test_true_weights_leave_less_than_others(
    model: HandModel, template: Template, mean: PopulationMean, poses: dict[str, NDArray]
) -> None:
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], poses["bent"]])
    posed = PosedTemplate(template, template.shape(), pose[None])
    mesh = trimesh.Trimesh(posed.vertices[0], model.faces, process=False)
    scans = [Scan.of_mesh(mesh, subject="a", pose="bent", template_faces=model.faces)]
    angles = poses["bent"][None]
    fitter = SubjectFitter(template, scans, angles, mean, LearningOptions())
    fit = fitter.improve(start_subject(template, scans, angles), 0)
    support = WeightSupport.of(model)
    forms = fitter.weight_terms(fit, support.bones)
    right = np.take_along_axis(support.first, support.bones, axis=1)
    wrong = np.full_like(right, 0.25)
    left = [np.einsum("vi,vij,vj->", w, forms, w) for w in (right, wrong)]
    assert left[0] < 1e-6 * left[1]


def test_laplacian_sums_squared_differences_along_edges() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    values = np.array([0.0, 1.0, 3.0, 7.0])
    edges = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    expected = sum((values[a] - values[b]) ** 2 for a, b in edges)
    assert values @ (neighbour_laplacian(faces) @ values) == pytest.approx(expected)
