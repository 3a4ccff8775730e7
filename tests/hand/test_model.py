"""The hand artifact: what it must hold, what it does, and how bad files are told."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, HandtrackError, MissingFileError
from handtrack.hand.kinematics import keypoints, skin
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import (
    ANGLES,
    BASE_BONES,
    BONE_PARENTS,
    FINGERS,
    NANGLE,
    NBONE,
    finger_of_bone,
)
from oracles.scenes import hand_model, shaped_hand


def flat_pose(**angles: float) -> np.ndarray:
    """Palm frame at the camera's, flat hand but for the named angles."""
    pose = np.zeros(28)
    pose[3] = 1.0
    for name, value in angles.items():
        pose[7 + ANGLES.index(name)] = value
    return pose


def test_array_shapes_are_those_documented() -> None:
    model = hand_model()
    nvert, nalpha, nbeta = len(model.vertices), model.nalpha, model.nbeta
    shapes = {
        "vertices": (nvert, 3), "weight_bones": (nvert, 3), "weights": (nvert, 3),
        "bone_rotations": (NBONE, 3, 3), "bone_origins": (NBONE, 3), "tip_offsets": (5, 3),
        "dof_axes": (NANGLE, 3), "rest_angles": (NANGLE,), "limits": (NANGLE, 2),
        "scale_mean": (NBONE + 1,), "scale_basis": (NBONE + 1, nalpha),
        "offset_mean": (nvert + 5, 3), "offset_basis": (nvert + 5, 3, nbeta),
    }  # fmt: skip
    for name, shape in shapes.items():
        array = getattr(model, name)
        assert array.shape == shape, name
        assert np.isfinite(array).all(), name
    assert model.faces.ndim == 2 and model.faces.shape[1] == 3
    assert nalpha >= 1 and nbeta >= 1


def test_the_artifact_says_where_it_comes_from() -> None:
    path = artifact_path("hand.npz")
    assert path.stat().st_size <= 4 * 2**20
    with np.load(path, allow_pickle=False) as data:
        for name in ("licence", "source", "config_hash"):
            assert str(data[name]), name
        for name in ("scale_variance", "offset_variance"):
            # Enough components for 95 % of the variance, largest first.
            assert data[name].sum() >= 0.95 and (np.diff(data[name]) <= 1e-9).all()


def test_the_mesh_is_watertight() -> None:
    faces = hand_model().faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = Counter(map(tuple, edges.tolist()))
    # Every edge is used once in each direction: closed, two-sided, consistently oriented.
    assert set(directed.values()) == {1}
    assert all((b, a) in directed for a, b in directed)
    assert len(np.unique(faces)) == len(hand_model().vertices)


def test_weights_are_shares_of_the_palm_and_one_finger() -> None:
    model = hand_model()
    assert (model.weights >= 0).all()
    np.testing.assert_allclose(model.weights.sum(1), 1.0, atol=1e-6)
    assert model.weight_bones.min() >= 0 and model.weight_bones.max() < NBONE
    for bones, weights in zip(model.weight_bones, model.weights, strict=True):
        used = {finger_of_bone(int(b)) for b, w in zip(bones, weights, strict=True) if w > 0}
        assert len(used - {-1}) <= 1


def test_every_bone_moves_some_skin() -> None:
    model = hand_model()
    for bone in range(NBONE):
        assert model.weights[model.weight_bones == bone].max(initial=0.0) > 0.5


def test_frames_are_rotations_and_bones_point_along_x() -> None:
    model = hand_model()
    products = model.bone_rotations @ np.swapaxes(model.bone_rotations, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (NBONE, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(model.bone_rotations), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(model.dof_axes, axis=1), 1.0, atol=1e-6)
    for bone, parent in enumerate(BONE_PARENTS):
        if parent > 0:
            np.testing.assert_allclose(model.bone_origins[bone, 1:], 0.0, atol=1e-9)
            assert model.bone_origins[bone, 0] > 0.005
    np.testing.assert_allclose(model.tip_offsets[:, 1:], 0.0, atol=1e-9)
    np.testing.assert_array_equal(model.bone_rotations[0], np.eye(3))
    np.testing.assert_array_equal(model.bone_origins[0], 0.0)


def test_limits_hold_the_rest_pose() -> None:
    model = hand_model()
    low, high = model.limits.T
    assert (low < high).all()
    assert (low <= model.rest_angles).all() and (model.rest_angles <= high).all()
    assert np.abs(model.limits).max() < np.pi


def test_without_shape_the_rest_pose_is_the_template() -> None:
    model = hand_model()
    plain = replace(
        model,
        scale_mean=np.ones(NBONE + 1),
        scale_basis=np.zeros((NBONE + 1, 1)),
        offset_mean=np.zeros_like(model.offset_mean),
        offset_basis=np.zeros((len(model.vertices) + 5, 3, 1)),
    ).shaped()
    pose = flat_pose()
    pose[7:] = model.rest_angles
    np.testing.assert_allclose(skin(plain, pose), model.vertices, atol=1e-9)


@pytest.mark.parametrize("side", ["right", "left"])
def test_positive_flexion_bends_towards_the_palm(side: str) -> None:
    hand = shaped_hand(side)
    flat = keypoints(hand, flat_pose())
    for finger, name in enumerate(FINGERS[1:], start=1):
        bent = keypoints(hand, flat_pose(**{f"{name}_mcp_flexion": 1.0}))
        tip = 4 + 4 * finger
        # Palmar is +y of the palm frame.
        assert bent[tip, 1] - flat[tip, 1] > 0.03, name
        assert bent[tip, 0] < flat[tip, 0], name
        for joint in ("pip", "dip"):
            curled = keypoints(hand, flat_pose(**{f"{name}_{joint}_flexion": 1.0}))
            assert curled[tip, 1] - flat[tip, 1] > 0.01, (name, joint)


@pytest.mark.parametrize("side", ["right", "left"])
def test_positive_abduction_spreads_the_fingers(side: str) -> None:
    hand = shaped_hand(side)
    flat = keypoints(hand, flat_pose())
    radial = 1.0 if side == "right" else -1.0
    directions = {"index": 1, "middle": 1, "ring": -1, "little": -1}
    for name, direction in directions.items():
        tip = 4 + 4 * FINGERS.index(name)
        spread = keypoints(hand, flat_pose(**{f"{name}_mcp_abduction": 0.3}))
        assert (spread[tip, 2] - flat[tip, 2]) * radial * direction > 0.01, name


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_hand_is_laid_out_as_documented(side: str) -> None:
    hand = shaped_hand(side)
    points = keypoints(hand, flat_pose())
    np.testing.assert_array_equal(points[0], 0.0)
    # x of the palm frame goes to the middle finger's knuckle, z to the thumb's side.
    assert np.abs(points[9, 1:]).max() < 0.1 * points[9, 0]
    radial = 1.0 if side == "right" else -1.0
    order = points[[5, 9, 13, 17], 2] * radial
    assert (np.diff(order) < 0).all()
    assert points[4, 2] * radial > order[0]
    # Palmar flesh lies at +y of the middle metacarpal, fingertips beyond the knuckles.
    assert (points[[8, 12, 16, 20], 0] > points[[5, 9, 13, 17], 0]).all()
    assert hand.cut_x < 0


def test_hands_of_the_population_have_plausible_sizes() -> None:
    model = hand_model()
    lengths = []
    for seed in range(20):
        hand = model.shaped(model.sample_shape(np.random.default_rng(seed)))
        points = keypoints(hand, flat_pose())
        lengths.append(points[12, 0])
        assert (hand.bone_lengths > 0.008).all()
        assert set(np.sign(hand.bone_origins[list(BASE_BONES[1:]), 0])) == {1.0}
    # Wrist to middle fingertip, from a child of ten to a large man.
    assert 0.12 < min(lengths) and max(lengths) < 0.24


def test_the_model_cannot_be_changed_by_accident() -> None:
    with pytest.raises(AttributeError):
        hand_model().cut_x = 0.0  # type: ignore[misc]


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nothing\.npz.*README") as caught:
        HandModel.load(tmp_path / "nothing.npz")
    assert isinstance(caught.value, FileNotFoundError) and isinstance(caught.value, HandtrackError)


def stored(**changed: object) -> dict:
    """Content of the artifact with entries changed or, when None, left out."""
    with np.load(artifact_path("hand.npz"), allow_pickle=False) as data:
        values = {name: data[name] for name in data.files}
    values.update(changed)
    return {name: value for name, value in values.items() if value is not None}


def test_a_rewritten_copy_loads_alike(tmp_path: Path) -> None:
    path = tmp_path / "hand.npz"
    np.savez(path, **stored())
    again = HandModel.load(path)
    for field in fields(HandModel):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(hand_model(), field.name))


def test_a_newer_format_is_told(tmp_path: Path) -> None:
    path = tmp_path / "hand.npz"
    np.savez(path, **stored(format_version=99))
    with pytest.raises(DamagedFileError, match="format 99"):
        HandModel.load(path)


@pytest.mark.parametrize("name", [f.name for f in fields(HandModel)] + ["format_version"])
def test_a_lacking_entry_is_told(tmp_path: Path, name: str) -> None:
    path = tmp_path / "hand.npz"
    np.savez(path, **stored(**{name: None}))
    with pytest.raises(DamagedFileError, match=name):
        HandModel.load(path)


@pytest.mark.parametrize(
    "changed",
    [
        {"vertices": np.zeros((10, 3), np.float32)},
        {"weights": np.full((3,), np.nan, np.float32)},
        {"scale_mean": np.zeros(3)},
        {"limits": np.zeros((21, 3))},
        {"faces": np.full((4, 3), 10**6, np.int32)},
        {"cut_x": np.zeros(3)},
        {"dof_axes": np.full((21, 3), np.nan)},
        {"rest_angles": np.array(["a"] * 21)},
        {"limits": np.array([None] * 21, object)},
        {"format_version": np.zeros(2)},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_entries_that_do_not_fit_are_told(tmp_path: Path, changed: dict) -> None:
    path = tmp_path / "hand.npz"
    np.savez(path, **stored(**changed))
    with pytest.raises(DamagedFileError, match=r"hand\.npz"):
        HandModel.load(path)


@pytest.mark.parametrize("content", [b"", b"not a model", b"PK\x03\x04rest", b"\x93NUMPY\x01"])
def test_a_file_of_another_kind_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "hand.npz"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"hand\.npz"):
        HandModel.load(path)


def test_a_bare_array_is_told(tmp_path: Path) -> None:
    path = tmp_path / "hand.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DamagedFileError, match=r"hand\.npz"):
        HandModel.load(path)


@settings(
    deadline=None,
    max_examples=25,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_a_damaged_artifact_loads_or_is_told(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(artifact_path("hand.npz").read_bytes())
    # Half of the hits in the directory at the end and the headers, where they hurt most.
    for _ in range(data.draw(st.integers(1, 8))):
        place = st.one_of(
            st.integers(0, len(content) - 1), st.integers(-3000, -1), st.integers(0, 200)
        )
        content[data.draw(place)] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    path = tmp_path / "hand.npz"
    path.write_bytes(content)
    try:
        model = HandModel.load(path)
    except DamagedFileError:
        return
    assert model.vertices.shape == hand_model().vertices.shape
