"""The distance field: against exact distances and brute force, outside its grid, in kernels."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
import warp as wp

from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.kernels.distance_field import look_up_distances
from handtrack.objects import shapes
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from oracles.winding import winding_numbers


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Signed distance from a box in the middle."""
    over = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=-1)
    return outside + np.minimum(over.max(-1), 0.0)


def test_field_of_a_box_and_of_a_ball_is_exact_within_the_grid(
    device: str, rng: np.random.Generator
) -> None:
    box = DistanceField.of(
        RigidObject.of_shape(shapes.box(0.04, 0.06, 0.08), name="box", mass=0.1), device=device
    )
    points = rng.uniform(-0.06, 0.06, (4000, 3)) * [0.8, 1.0, 1.1]
    exact = box_distance(points, np.array([0.02, 0.03, 0.04]))
    # Trilinear interpolation errs only across edges and middle planes, by part of a 2 mm cell.
    errors = np.abs(box.distance(points) - exact)
    assert np.median(errors) < 2e-5
    assert errors.max() < 0.0012
    ball = DistanceField.of(RigidObject.sphere(0.03, mass=0.1), device=device)
    away = np.linalg.norm(points, axis=1)
    errors = np.abs(ball.distance(points) - (away - 0.03))[(away > 0.01) & (away < 0.06)]
    assert errors.max() < 2e-4
    sides = (away > 0.02) & (away < 0.055)
    slope = ball.normal(points[sides])
    assert (slope * points[sides] / away[sides, None]).sum(1).min() > 0.998


def test_field_equals_brute_force_where_parts_overlap(rng: np.random.Generator) -> None:
    body = load_object("hammer")
    field = DistanceField.of(body, device="cpu")
    nodes = np.stack([rng.integers(0, n, 120) for n in field.values.shape], axis=1)
    # Where grid points lie on the flat sides, inside or not is a matter of rounding.
    nodes = nodes[np.abs(field.values[tuple(nodes.T)]) > 1e-6]
    points = field.origin + field.spacing * nodes
    inside = winding_numbers(body.vertices, body.faces, points) > 0.5
    found = field.values[tuple(nodes.T)]
    assert inside.sum() > 3
    np.testing.assert_array_equal(found < 0, inside)
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    _, nearest, _ = trimesh.proximity.closest_point_naive(mesh, points[~inside])
    np.testing.assert_allclose(found[~inside], nearest, atol=1e-6)


def test_outside_the_grid_the_way_to_it_is_added() -> None:
    field = DistanceField.of(RigidObject.sphere(0.02, mass=0.1), device="cpu")
    far = np.array([[0.5, 0.0, 0.0], [0.0, -0.3, 0.4]])
    # The box's border is 30 mm away: the way through its nearest point is no shorter, and longer
    # by at most the box's half diagonal.
    longer = field.distance(far) - (np.linalg.norm(far, axis=1) - 0.02)
    assert (longer > -1e-4).all()
    assert (longer < 0.05).all()
    assert field.distance(np.array([0.5, 0.0, 0.0])) == pytest.approx(0.48, abs=1e-3)


def test_projected_points_lie_on_the_surface(rng: np.random.Generator) -> None:
    field = DistanceField.of(load_object("apple"), device="cpu")
    points = field.project(rng.uniform(-0.05, 0.05, (300, 3)))
    assert np.quantile(np.abs(field.distance(points)), 0.98) < 2e-4


def test_kernels_read_what_the_host_reads(device: str, rng: np.random.Generator) -> None:
    where = resolve_device(device)
    field = DistanceField.of(load_object("pear"), device=device)
    points = rng.uniform(-0.1, 0.1, (500, 3)).astype(np.float32)
    distances = wp.full(500, np.nan, dtype=float, device=where)
    normals = wp.full(500, wp.vec3(np.nan), dtype=wp.vec3, device=where)
    look_up_distances(
        field.upload(where), wp.array(points, dtype=wp.vec3, device=where),
        distances=distances, normals=normals,
    )  # fmt: skip
    np.testing.assert_allclose(distances.numpy(), field.distance(points), atol=2e-6)
    slope = field.gradient(points)
    clear = np.linalg.norm(slope, axis=1) > 0.5
    alike = (normals.numpy() * field.normal(points)).sum(1)
    assert alike[clear].min() > 0.999


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"spacing": 0.0}, "spacing"), ({"margin": 0.0001}, "margin"),
        ({"spacing": 0.0001}, "too large"),
    ],
)  # fmt: skip
def test_grids_that_make_no_sense_are_refused(options: dict, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        DistanceField.of(load_object("cube_110"), device="cpu", **options)


def test_an_open_mesh_has_no_inside() -> None:
    mesh = trimesh.creation.box((0.05, 0.05, 0.05))
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    with pytest.raises(InputError, match="is open"):
        DistanceField.of(mesh, device="cpu")
