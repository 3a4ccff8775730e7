"""Rigid objects: mass properties, meshes of others, files, and surfaces that bound no body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.objects import shapes
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject


def test_inertia_of_a_box_is_that_of_the_textbook_and_scales_with_mass() -> None:
    body = RigidObject.of_shape(shapes.box(0.04, 0.06, 0.1), name="box", mass=0.3)
    x, y, z = 0.04**2, 0.06**2, 0.1**2
    np.testing.assert_allclose(
        body.inertia, np.diag([y + z, x + z, x + y]) * 0.3 / 12, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(replace(body, mass=0.6).inertia, 2 * body.inertia)


def test_density_gives_the_mass_of_the_volume() -> None:
    body = RigidObject.of_shape(shapes.box(0.1, 0.1, 0.1), name="box", density=700.0)
    assert body.mass == pytest.approx(0.7)
    with pytest.raises(InputError, match="leave one out"):
        RigidObject.of_shape(shapes.sphere(0.1), name="ball", mass=0.1, density=700.0)


@pytest.mark.parametrize(("mass", "friction"), [(0.0, 0.8), (np.nan, 0.8), (0.1, -1.0)])
def test_unusable_mass_or_friction_is_refused(mass: float, friction: float) -> None:
    with pytest.raises(InputError, match="expected"):
        RigidObject.of_shape(shapes.sphere(0.05), name="ball", mass=mass, friction=friction)


def open_box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def inverted_box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh.invert()
    return mesh


def flat_box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh.vertices[:, 2] *= 1e-9
    return mesh


def mixed_box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    faces = np.array(mesh.faces)
    faces[0] = faces[0, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (open_box(), "is open"),
        (inverted_box(), "inside out"),
        (mixed_box(), "face both ways"),
        (trimesh.Trimesh(), "is empty"),
        (flat_box(), "has no volume|is open"),
        (trimesh.creation.box((50.0, 50.0, 50.0)), "50 m long.*millimetres"),
        (trimesh.creation.box((1e-4, 1e-4, 1e-4)), "m long"),
    ],
    ids=["open", "inverted", "mixed", "empty", "flat", "huge", "tiny"],
)
def test_a_surface_that_bounds_no_body_is_refused(mesh: trimesh.Trimesh, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as caught:
        RigidObject.from_mesh(mesh, name="thing")
    assert "\n" not in str(caught.value)


def test_a_mesh_that_is_not_convex_is_cut_into_convex_pieces_the_same_each_time() -> None:
    pytest.importorskip("coacd")
    bar = trimesh.creation.box((0.06, 0.02, 0.02))
    assert RigidObject.from_mesh(bar, name="bar").pieces[0].shape == (8, 3)
    corners = 0.02 * np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    angle = trimesh.creation.extrude_triangulation(corners, triangles, 0.02)
    first = RigidObject.from_mesh(angle, name="angle", mass=0.1)
    again = RigidObject.from_mesh(angle, name="angle", mass=0.1)
    assert len(first.pieces) >= 2
    for piece, other in zip(first.pieces, again.pieces, strict=True):
        np.testing.assert_array_equal(piece, other)
    hulls = [trimesh.convex.convex_hull(piece + angle.center_mass) for piece in first.pieces]
    assert sum(hull.volume for hull in hulls) == pytest.approx(angle.volume, rel=0.1)
    # The inner corner stays open.
    assert not any(hull.contains([[0.03, 0.03, 0.01]])[0] for hull in hulls)


def test_a_mesh_file_in_millimetres_is_read_with_a_scale(tmp_path: Path) -> None:
    path = tmp_path / "block.stl"
    trimesh.creation.box((40.0, 50.0, 60.0)).export(path)
    body = RigidObject.from_mesh(path, scale=0.001, mass=0.2)
    assert body.name == "block"
    np.testing.assert_allclose(body.extents, [0.04, 0.05, 0.06])
    with pytest.raises(InputError, match="scale"):
        RigidObject.from_mesh(path, scale=0.0)


def test_files_that_are_no_mesh_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no mesh at"):
        RigidObject.from_mesh(tmp_path / "nothing.obj")
    broken = tmp_path / "broken.stl"
    broken.write_bytes(b"no triangles here")
    with pytest.raises(DamagedFileError, match=r"broken\.stl"):
        RigidObject.from_mesh(broken)


@pytest.mark.parametrize("name", ["sphere_55", "cup"])
def test_a_saved_object_is_read_back_as_it_was(name: str, tmp_path: Path) -> None:
    body = load_object(name)
    body.save(tmp_path / "body.npz")
    back = RigidObject.load(tmp_path / "body.npz")
    assert (back.name, back.mass, back.friction) == (body.name, body.mass, body.friction)
    assert back.primitive == body.primitive
    np.testing.assert_array_equal(back.vertices, body.vertices)
    np.testing.assert_array_equal(back.faces, body.faces)
    np.testing.assert_array_equal(back.unit_inertia, body.unit_inertia)
    assert len(back.pieces) == len(body.pieces)
    for piece, other in zip(back.pieces, body.pieces, strict=True):
        np.testing.assert_array_equal(piece, other)


def test_files_that_are_no_object_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no object at"):
        RigidObject.load(tmp_path / "nothing.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", x=1)
    for name in ("text.npz", "other.npz"):
        with pytest.raises(DamagedFileError, match=name):
            RigidObject.load(tmp_path / name)
