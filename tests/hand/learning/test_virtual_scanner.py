"""The virtual scanner: its own tessellation, holes, gaps and noise."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.kinematics import skin
from handtrack.hand.learning.virtual_scanner import ScannerOptions, virtual_scan
from handtrack.hand.model import HandModel
from handtrack.hand.surface_distance import surface_distance

CLEAN = ScannerOptions(vertices=4000, noise=0.0, holes=0, gap=0.0)


def rim(mesh: trimesh.Trimesh) -> int:
    return len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))


def test_a_clean_scan_is_the_surface_on_other_vertices(
    model: HandModel, open_faces: NDArray[np.int32]
) -> None:
    scan = virtual_scan(model.vertices, open_faces, np.random.default_rng(0), CLEAN)
    assert len(scan.vertices) == 4000
    away = surface_distance(scan.vertices, model.vertices, open_faces)
    assert np.quantile(away, 0.999) < 1e-9 and away.max() < 0.0002
    # Chords of the surface cut its curves, by much less than the noise of a scanner.
    hand = surface_distance(model.vertices[model.vertices[:, 0] > 0], scan.vertices, scan.faces)
    assert hand.mean() < 0.0003
    assert np.unique(scan.edges_sorted, axis=0, return_counts=True)[1].max() == 2
    assert rim(scan) < 60
    outward = np.einsum("fi,fi->f", scan.face_normals, scan.triangles_center - scan.centroid)
    assert np.mean(outward > 0) > 0.7


def test_noise_has_its_size(model: HandModel, open_faces: NDArray[np.int32]) -> None:
    noisy = ScannerOptions(vertices=4000, noise=0.0003, holes=0, gap=0.0)
    scan = virtual_scan(model.vertices, open_faces, np.random.default_rng(0), noisy)
    away = surface_distance(scan.vertices, model.vertices, open_faces)
    assert np.sqrt((away**2).mean()) == pytest.approx(0.0003, rel=0.1)


def test_holes_and_narrow_gaps_are_missing(model: HandModel, open_faces: NDArray[np.int32]) -> None:
    holed = ScannerOptions(vertices=4000, noise=0.0, holes=3, gap=0.0)
    assert rim(virtual_scan(model.vertices, open_faces, np.random.default_rng(0), holed)) > 60
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], np.zeros(21)])
    closed = np.clip(pose[7:], *model.limits.T)
    closed[[6, 14, 18]] = np.radians([-10.0, -10.0, -17.0])  # fingers side by side
    vertices = skin(model.shaped(), np.concatenate([pose[:7], closed]))
    gaps = ScannerOptions(vertices=4000, noise=0.0, holes=0, gap=0.003)
    seen = virtual_scan(vertices, open_faces, np.random.default_rng(0), gaps)
    everything = virtual_scan(vertices, open_faces, np.random.default_rng(0), CLEAN)
    assert seen.area < 0.99 * everything.area


@pytest.mark.parametrize("wrong", [{"vertices": 10}, {"noise": -1.0}, {"hole_radius": (2.0, 1.0)}])
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="expected"):
        ScannerOptions(**wrong)
