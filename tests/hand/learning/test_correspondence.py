"""Correspondences between a posed template and its scan."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from handtrack.hand.learning.correspondence import ScanSurface
from handtrack.hand.learning.posed_template import PosedTemplate, Template
from handtrack.hand.learning.scans import Scan
from handtrack.hand.model import HandModel

REST_PLACE = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def posed(model: HandModel, template: Template) -> PosedTemplate:
    pose = np.concatenate([REST_PLACE, model.rest_angles])
    return PosedTemplate(template, template.shape(), pose[None])


@pytest.fixture(scope="module")
def mesh(posed: PosedTemplate, open_faces: NDArray[np.int32]) -> trimesh.Trimesh:
    return trimesh.Trimesh(posed.vertices[0], open_faces, process=False).subdivide()


def test_every_vertex_of_a_whole_scan_finds_itself_but_for_the_rim(
    posed: PosedTemplate, mesh: trimesh.Trimesh
) -> None:
    surface = ScanSurface(Scan.of_mesh(mesh, subject="a", pose="rest"))
    matches = surface.match(posed.vertices[0], posed.normals[0], reach=0.005)
    found = matches.weights > 0
    assert 0.97 < found.mean() < 1.0
    # Beside the rim, the nearest point with a like normal may be another.
    assert np.quantile(matches.distances(posed.vertices[0]), 0.98) < 1e-9


def test_vertices_over_a_hole_have_no_match(posed: PosedTemplate, mesh: trimesh.Trimesh) -> None:
    vertices = posed.vertices[0]
    centre = vertices[np.abs(vertices - np.array([0.06, 0.02, 0.0])).sum(axis=1).argmin()]
    holed = mesh.copy()
    near = np.linalg.norm(holed.vertices - centre, axis=1) < 0.018
    holed.update_faces(~near[holed.faces].any(axis=1))
    surface = ScanSurface(Scan.of_mesh(holed, subject="a", pose="rest"))
    matches = surface.match(vertices, posed.normals[0], reach=0.02)
    inside = np.linalg.norm(vertices - centre, axis=1) < 0.013
    assert inside.sum() >= 3
    assert not matches.weights[inside].any()


def test_surfaces_that_face_the_other_way_are_no_match(
    posed: PosedTemplate, mesh: trimesh.Trimesh
) -> None:
    inside_out = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    surface = ScanSurface(Scan.of_mesh(inside_out, subject="a", pose="rest"))
    matches = surface.match(posed.vertices[0], posed.normals[0], reach=0.005)
    assert (matches.weights > 0).mean() < 0.02


def test_distant_scans_are_no_match(posed: PosedTemplate, mesh: trimesh.Trimesh) -> None:
    away = mesh.copy()
    away.apply_translation([0.0, 0.5, 0.0])
    surface = ScanSurface(Scan.of_mesh(away, subject="a", pose="rest"))
    assert not surface.match(posed.vertices[0], posed.normals[0], reach=0.03).weights.any()


def test_scan_points_ask_back_but_not_for_the_arm(
    posed: PosedTemplate, template: Template, mesh: trimesh.Trimesh
) -> None:
    surface = ScanSurface(Scan.of_mesh(mesh, subject="a", pose="rest"))
    back = surface.match_back(posed.vertices[0], posed.normals[0], template.stub, reach=0.01)
    asked = back.vertices[back.weights > 0]
    assert len(asked) > 300
    assert not template.stub[asked].any()


def test_registered_scans_answer_with_their_own_vertices(
    posed: PosedTemplate, model: HandModel, template: Template
) -> None:
    same = trimesh.Trimesh(posed.vertices[0] + 0.4, model.faces, process=False)
    scan = Scan.of_mesh(same, subject="a", pose="rest", template_faces=model.faces)
    surface = ScanSurface(scan)
    matches = surface.match(posed.vertices[0], posed.normals[0], reach=0.001)
    assert matches.exact and matches.weights.all()
    np.testing.assert_allclose(matches.targets, same.vertices)
    back = surface.match_back(posed.vertices[0], posed.normals[0], template.stub, reach=0.01)
    assert not len(back.vertices)


def test_rows_of_plane_and_point_matches_have_their_residuals(
    posed: PosedTemplate, mesh: trimesh.Trimesh
) -> None:
    shifted = posed.vertices[0] + np.array([0.0005, 0.0, 0.0])
    surface = ScanSurface(Scan.of_mesh(mesh, subject="a", pose="rest"))
    matches = surface.match(shifted, posed.normals[0], reach=0.005)
    jacobian = np.broadcast_to(np.eye(3), (len(shifted), 3, 3))
    rows, away = matches.rows(jacobian, shifted)
    form = np.einsum("vi,vij,vj->", matches.away(shifted), matches.metric(), matches.away(shifted))
    assert away @ away == pytest.approx(form)
    assert rows.shape == (len(away), 3)
