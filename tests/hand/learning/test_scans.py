"""Scan folders: names, units, sides, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.kinematics import skin
from handtrack.hand.learning.scans import Scan, find_scans, read_scan
from handtrack.hand.model import HandModel


@pytest.fixture
def mesh(model: HandModel, open_faces: NDArray[np.int32]) -> trimesh.Trimesh:
    return trimesh.Trimesh(model.vertices[:-1], open_faces, process=False)


def test_names_tell_subject_and_pose(tmp_path: Path, mesh: trimesh.Trimesh) -> None:
    for name in ("a_fist.ply", "a_thumbs_up.obj", "b_fist-2.ply"):
        mesh.export(tmp_path / name)
    (tmp_path / "truth.npz").write_bytes(b"")
    found = find_scans(tmp_path)
    assert {s: [f.pose for f in files] for s, files in found.items()} == {
        "a": ["fist", "thumbs_up"],
        "b": ["fist"],
    }


def test_no_folder_no_scans_and_names_without_a_pose_are_refused(
    tmp_path: Path, mesh: trimesh.Trimesh
) -> None:
    with pytest.raises(MissingFileError, match="no folder"):
        find_scans(tmp_path / "nowhere")
    with pytest.raises(MissingFileError, match="SUBJECT_POSE"):
        find_scans(tmp_path)
    mesh.export(tmp_path / "anna.ply")
    with pytest.raises(InputError, match="does not tell whose"):
        find_scans(tmp_path)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_what_is_no_mesh_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a_fist{suffix}").write_bytes(b"nothing of the kind")
    (file,) = find_scans(tmp_path)["a"]
    with pytest.raises(DamagedFileError, match=f"a_fist{suffix} cannot be read"):
        read_scan(file)


def test_points_without_triangles_are_refused(tmp_path: Path) -> None:
    trimesh.PointCloud(np.random.default_rng(0).random((500, 3))).export(tmp_path / "a_fist.ply")
    (file,) = find_scans(tmp_path)["a"]
    with pytest.raises(DamagedFileError, match="triangle"):
        read_scan(file)


def test_millimetres_are_told_from_metres(tmp_path: Path, mesh: trimesh.Trimesh) -> None:
    large = mesh.copy()
    large.apply_scale(1000.0)
    large.export(tmp_path / "a_fist.ply")
    (file,) = find_scans(tmp_path)["a"]
    with pytest.raises(InputError, match=r"expected a hand of .*'mm'"):
        read_scan(file)
    (file,) = find_scans(tmp_path, unit="mm")["a"]
    np.testing.assert_allclose(np.ptp(read_scan(file).points, 0), np.ptp(mesh.vertices, 0), 1e-5)


def test_left_scans_become_right_ones(tmp_path: Path, model: HandModel) -> None:
    left = model.shaped(side="left")
    right = model.shaped()
    flat = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], model.rest_angles])
    trimesh.Trimesh(skin(left, flat), left.faces, process=False).export(tmp_path / "a_rest.ply")
    (file,) = find_scans(tmp_path, side="left")["a"]
    scan = read_scan(file, template_faces=model.faces)
    assert scan.registered
    np.testing.assert_allclose(scan.points, skin(right, flat), atol=1e-6)
    outward = np.einsum("vi,vi->v", scan.normals, scan.points - scan.points.mean(axis=0))
    assert np.mean(outward > 0) > 0.7


def test_rim_is_marked_and_debris_dropped(mesh: trimesh.Trimesh) -> None:
    crumb = trimesh.creation.icosphere(subdivisions=0, radius=0.002)
    crumb.apply_translation([0.3, 0.0, 0.0])
    whole = trimesh.util.concatenate([mesh, crumb])
    # Every triangle with vertices of its own, as some scanners write them.
    loose = trimesh.Trimesh(
        whole.triangles.reshape(-1, 3),
        np.arange(3 * len(whole.faces)).reshape(-1, 3),
        process=False,
    )
    scan = Scan.of_mesh(loose, subject="a", pose="rest")
    assert len(scan.points) == len(mesh.vertices)
    assert scan.points[:, 0].max() < 0.25
    # The only rim is the cut through the arm.
    assert 10 < scan.on_edge.sum() < 60
    assert scan.points[scan.on_edge, 0].max() < 0.0


def test_large_scans_are_thinned_but_keep_their_rim(mesh: trimesh.Trimesh) -> None:
    fine = mesh.subdivide()
    whole = Scan.of_mesh(fine, subject="a", pose="rest")
    thin = Scan.of_mesh(fine, subject="a", pose="rest", max_points=1000)
    assert thin.on_edge.sum() == whole.on_edge.sum()
    assert (~thin.on_edge).sum() == 1000
