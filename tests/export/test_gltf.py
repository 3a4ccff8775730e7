"""The .glb, read by pygltflib and skinned here by the rules of the glTF 2.0 specification."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from handtrack.export.gltf import gltf
from handtrack.export.skin_binding import bind
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames, keypoints, skin
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import BONES, KEYPOINTS

pygltflib = pytest.importorskip(
    "pygltflib", reason="pygltflib, which reads .glb independently, is not installed"
)

Float = NDArray[np.float64]

UPRIGHT = np.array([1.0, -1.0, -1.0])
KINDS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Scene:
    """A loaded file that can be posed at a time."""

    def __init__(self, path: Path) -> None:
        self.file: Any = pygltflib.GLTF2().load(str(path))
        self.blob = self.file.binary_blob()
        self.names = [node.name for node in self.file.nodes]

    def array(self, index: int) -> NDArray[Any]:
        accessor = self.file.accessors[index]
        view = self.file.bufferViews[accessor.bufferView]
        width = WIDTHS[accessor.type]
        kind = KINDS[accessor.componentType]
        start = view.byteOffset + (accessor.byteOffset or 0)
        assert start % np.dtype(kind).itemsize == 0 and view.byteStride is None
        array = np.frombuffer(self.blob, kind, accessor.count * width, start)
        array = array.reshape(accessor.count, width)
        np.testing.assert_array_equal(accessor.min, array.min(axis=0))
        np.testing.assert_array_equal(accessor.max, array.max(axis=0))
        return array

    def times(self) -> Float:
        return self.array(self.file.animations[0].samplers[0].input)[:, 0].astype(float)

    def node_transforms(self, time: float) -> dict[str, Float]:
        """Global matrix of every node at a time, by its name."""
        local = {}
        for index, node in enumerate(self.file.nodes):
            local[index] = {
                "translation": np.array(node.translation or [0.0, 0.0, 0.0]),
                "rotation": np.array(node.rotation or [0.0, 0.0, 0.0, 1.0]),
            }
        animation = self.file.animations[0]
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert sampler.interpolation == "LINEAR"
            keys, values = self.array(sampler.input)[:, 0], self.array(sampler.output)
            assert len(keys) == len(values)
            if channel.target.path == "rotation":
                np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, atol=1e-6)
                sampled = Slerp(keys, Rotation.from_quat(values))(time).as_quat()
            else:
                sampled = np.array([np.interp(time, keys, values[:, k]) for k in range(3)])
            local[channel.target.node][channel.target.path] = sampled
        out: dict[str, Float] = {}

        def visit(index: int, parent: Float) -> None:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(local[index]["rotation"]).as_matrix()
            matrix[:3, 3] = local[index]["translation"]
            out[self.names[index]] = parent @ matrix
            for child in self.file.nodes[index].children or []:
                visit(child, parent @ matrix)

        for root in self.file.scenes[self.file.scene].nodes:
            visit(root, np.eye(4))
        return out

    def skinned(self, time: float) -> Float:
        """Vertices at a time: sum of weights x joint matrix x inverse bind matrix x position."""
        attributes = self.file.meshes[0].primitives[0].attributes
        position = self.array(attributes.POSITION).astype(float)
        joints, weights = self.array(attributes.JOINTS_0), self.array(attributes.WEIGHTS_0)
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
        hand_skin = self.file.skins[0]
        inverse = self.array(hand_skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        np.testing.assert_array_equal(inverse[:, 3], np.tile([0, 0, 0, 1], (len(inverse), 1)))
        found = self.node_transforms(time)
        palette = np.stack([found[self.names[node]] for node in hand_skin.joints]) @ inverse
        blended = np.einsum("vk,vkij->vij", weights, palette[joints])
        return np.einsum("vij,vj->vi", blended[:, :3, :3], position) + blended[:, :3, 3]


@pytest.fixture(scope="module")
def path(track: Track, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gltf") / "hand.glb"
    path.write_bytes(gltf(track))
    return path


@pytest.fixture(scope="module")
def scene(path: Path) -> Scene:
    return Scene(path)


def test_the_skin_is_that_of_the_hand_in_every_frame(scene: Scene, track: Track) -> None:
    times = scene.times()
    np.testing.assert_allclose(times, track.times - track.times[0], atol=1e-6)
    for time, pose in zip(times, track.held_poses(), strict=True):
        error = np.linalg.norm(scene.skinned(time) - skin(track.hand, pose) * UPRIGHT, axis=1)
        assert 1e3 * error.max() < 0.01  # mm


def test_bones_and_keypoints_are_nodes_in_their_places(scene: Scene, track: Track) -> None:
    for time, pose in zip(scene.times(), track.held_poses(), strict=True):
        found = scene.node_transforms(time)
        rotations, origins = bone_frames(track.hand, pose)
        for bone, name in enumerate(BONES):
            assert 1e3 * np.linalg.norm(found[name][:3, 3] - origins[bone] * UPRIGHT) < 0.01
            turn = found[name][:3, :3].T @ (UPRIGHT[:, None] * rotations[bone])
            assert np.rad2deg(Rotation.from_matrix(turn).magnitude()) < 0.01
        points = keypoints(track.hand, pose) * UPRIGHT
        for place, name in enumerate(KEYPOINTS):
            if name.endswith("tip"):
                assert 1e3 * np.linalg.norm(found[name][:3, 3] - points[place]) < 0.01


def test_the_hand_turns_the_short_way_between_frames(scene: Scene) -> None:
    for sampler in scene.file.animations[0].samplers[1:]:
        quats = scene.array(sampler.output)
        assert ((quats[1:] * quats[:-1]).sum(axis=1) >= 0.0).all()


def test_the_bind_is_exact_for_shapes_of_either_side(rng: np.random.Generator) -> None:
    model = HandModel.load()
    for which in ("right", "left"):
        hand = model.shaped(model.sample_shape(rng, deviation=2.0), side=which)
        rest, matrices = bind(hand)
        placed = np.einsum("vkij,vj->vki", matrices[hand.weight_bones, :3, :3], rest)
        placed += matrices[hand.weight_bones, :3, 3]
        np.testing.assert_allclose(placed, hand.local_vertices, atol=1e-12)


def test_the_mesh_at_rest_is_a_closed_hand(path: Path, track: Track) -> None:
    loaded = trimesh.load_scene(path, file_type="glb")
    (mesh,) = loaded.geometry.values()
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_watertight and mesh.volume > 1e-4 and len(mesh.vertices) == track.hand.nvert
    normals = mesh.vertex_normals
    outward = np.einsum("ij,ij->i", normals, mesh.vertices - mesh.centroid)
    assert (outward > 0.0).mean() > 0.7


def test_a_frame_that_is_not_later_has_no_key(track: Track, tmp_path: Path) -> None:
    times = track.times.copy()
    times[5] = times[4]
    times[9] = times[4] + 1e-9
    path = tmp_path / "hand.glb"
    path.write_bytes(gltf(replace(track, times=times)))
    scene = Scene(path)
    assert (np.diff(scene.times()) > 0.0).all() and len(scene.times()) == len(track) - 2
    assert scene.file.extras["frames"] == [k for k in range(len(track)) if k not in (5, 9)]


def test_the_file_says_what_it_is(scene: Scene, track: Track) -> None:
    extras = scene.file.extras
    assert extras["side"] == track.side and extras["source"] == "somewhere"
    assert extras["first_time"] == 100.0
    assert extras["states"] == [state.value for state in track.states]
    assert scene.file.asset.version == "2.0" and "handtrack" in scene.file.asset.generator
