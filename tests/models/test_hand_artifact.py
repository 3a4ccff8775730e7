"""The stored hand model: its format, its mesh, its skeleton and its shape space."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares

from handtrack.artifacts import artifact_path
from handtrack.hand.kinematics import bone_frames, keypoints, skin
from handtrack.hand.model import HandModel, ShapedHand, skeleton_frames
from handtrack.hand.skeleton import (
    ANGLE_BONES,
    ANGLES,
    BASE_BONES,
    BONE_PARENTS,
    DISTAL_BONES,
    FINGERS,
    NANGLE,
    NBONE,
    TIP_KEYPOINTS,
    finger_of_bone,
)

PATH = Path(artifact_path("hand.npz"))


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    with np.load(PATH, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


@pytest.fixture(scope="module")
def model() -> HandModel:
    return HandModel.load(PATH)


@pytest.fixture(scope="module")
def hand(model: HandModel) -> ShapedHand:
    return model.shaped()


def posed(**degrees: float) -> np.ndarray:
    """Pose at the origin with the named angles; names without a finger hold for all four."""
    angles = np.zeros(NANGLE)
    for k, name in enumerate(ANGLES):
        key = name if name in degrees else name.split("_", 1)[1]
        if name.startswith("thumb") and name not in degrees:
            continue
        angles[k] = np.radians(degrees.get(key, 0.0))
    return np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])


def test_file_is_small_and_names_its_origin(arrays: dict[str, np.ndarray]) -> None:
    assert PATH.stat().st_size < 4_000_000
    assert int(arrays["format_version"]) == 1
    assert str(arrays["licence"]) == "CC0-1.0"
    assert "MakeHuman" in str(arrays["source"])
    assert len(str(arrays["config_hash"])) == 16


def test_arrays_have_the_documented_shapes_and_types(arrays: dict[str, np.ndarray]) -> None:
    nvert, nface = len(arrays["vertices"]), len(arrays["faces"])
    nalpha, nbeta = arrays["scale_basis"].shape[1], arrays["offset_basis"].shape[2]
    shapes = {
        "vertices": (nvert, 3), "faces": (nface, 3), "weight_bones": (nvert, 3),
        "weights": (nvert, 3), "bone_rotations": (NBONE, 3, 3), "bone_origins": (NBONE, 3),
        "tip_offsets": (5, 3), "dof_axes": (NANGLE, 3), "rest_angles": (NANGLE,),
        "limits": (NANGLE, 2), "scale_mean": (NBONE + 1,), "scale_basis": (NBONE + 1, nalpha),
        "offset_mean": (nvert + 5, 3), "offset_basis": (nvert + 5, 3, nbeta),
        "scale_variance": (nalpha,), "offset_variance": (nbeta,), "cut_x": (),
    }  # fmt: skip
    for name, shape in shapes.items():
        assert arrays[name].shape == shape, name
        assert np.isfinite(arrays[name]).all(), name
    assert arrays["faces"].dtype == np.int32
    assert arrays["weight_bones"].dtype == np.int32
    assert arrays["vertices"].dtype == np.float32


def test_mesh_is_one_watertight_outward_surface_of_a_hands_volume(model: HandModel) -> None:
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number == 2
    # A hand has about 350 cm^3; the stub of forearm adds about 70.
    assert 300e-6 < mesh.volume < 480e-6
    assert mesh.area_faces.min() > 0


def test_cut_lies_a_few_centimetres_above_the_wrist(model: HandModel) -> None:
    assert -0.06 < model.cut_x < -0.03
    lowest = model.vertices[:, 0].min()
    assert abs(lowest - model.cut_x) < 0.006


def test_weights_sum_to_one_over_the_palm_and_one_finger(model: HandModel) -> None:
    np.testing.assert_allclose(model.weights.sum(axis=1), 1.0, atol=1e-6)
    assert (model.weights >= 0).all()
    fingers = np.vectorize(finger_of_bone)(model.weight_bones)
    for row, weights in zip(fingers, model.weights, strict=True):
        assert len({finger for finger in row[weights > 0] if finger >= 0}) <= 1
    used = model.weight_bones[model.weights > 0]
    assert set(used) == set(range(NBONE))


def test_bones_lie_along_x_and_frames_are_rotations(model: HandModel) -> None:
    identity = model.bone_rotations @ np.swapaxes(model.bone_rotations, 1, 2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(model.bone_rotations), 1.0, atol=1e-12)
    np.testing.assert_array_equal(model.bone_rotations[0], np.eye(3))
    inner = [b for b in range(1, NBONE) if b not in BASE_BONES]
    assert (model.bone_origins[inner, 0] > 0.01).all()
    np.testing.assert_array_equal(model.bone_origins[inner, 1:], 0.0)
    np.testing.assert_array_equal(model.tip_offsets[:, 1:], 0.0)
    # The palm's x axis runs through the middle knuckle, z through index and little knuckle.
    np.testing.assert_allclose(model.bone_origins[7, 1:], 0.0, atol=1e-12)
    assert model.bone_origins[4, 2] > 0 > model.bone_origins[13, 2]
    np.testing.assert_allclose(model.bone_origins[4, 1], model.bone_origins[13, 1], atol=1e-12)


def test_limits_hold_the_rest_pose_and_zero(model: HandModel) -> None:
    low, high = model.limits.T
    assert (low < 0).all() and (high > 0).all()
    assert (low < model.rest_angles).all() and (model.rest_angles < high).all()
    assert np.abs(model.limits).max() < np.radians(130)


def test_template_comes_back_from_its_own_skeleton_at_rest(model: HandModel) -> None:
    """Eq. II.9 with identity shape at the rest angles gives the stored vertices."""
    rotations, origins = skeleton_frames(
        model.bone_rotations, model.bone_origins, model.dof_axes, model.rest_angles
    )
    bones = model.weight_bones
    local = np.einsum("vkji,vkj->vki", rotations[bones], model.vertices[:, None] - origins[bones])
    back = np.einsum("vkij,vkj->vki", rotations[bones], local) + origins[bones]
    vertices = np.einsum("vk,vki->vi", model.weights, back)
    np.testing.assert_allclose(vertices, model.vertices, atol=1e-7)


def test_fingertips_of_the_template_lie_on_its_skin(model: HandModel) -> None:
    rotations, origins = skeleton_frames(
        model.bone_rotations, model.bone_origins, model.dof_axes, model.rest_angles
    )
    distal = list(DISTAL_BONES)
    tips = origins[distal] + (rotations[distal] @ model.tip_offsets[..., None])[..., 0]
    for tip in tips:
        # The tip is the mean of the last 2.5 mm of the finger, up to 1 mm off the finger's plane.
        assert np.linalg.norm(model.vertices - tip, axis=1).min() < 0.005


def test_joints_lie_inside_the_mesh(model: HandModel) -> None:
    _, origins = skeleton_frames(
        model.bone_rotations, model.bone_origins, model.dof_axes, model.rest_angles
    )
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    # Winding numbers: the solid angle of the surface seen from inside is 4 pi.
    for origin in origins:
        a, b, c = (mesh.triangles[:, k] - origin for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
        denominator = (
            la * lb * lc
            + np.einsum("ij,ij->i", a, b) * lc
            + np.einsum("ij,ij->i", b, c) * la
            + np.einsum("ij,ij->i", c, a) * lb
        )
        angle = 2 * np.arctan2(numerator, denominator).sum()
        assert angle == pytest.approx(4 * np.pi, abs=1e-6)


@pytest.mark.parametrize("name", [n for n in ANGLES if n.endswith("flexion") and "thumb" not in n])
def test_flexing_a_finger_moves_its_tip_palmar(hand: ShapedHand, name: str) -> None:
    tip = TIP_KEYPOINTS[FINGERS.index(name.split("_")[0])]
    moved = keypoints(hand, posed(**{name: 20.0}))[tip] - keypoints(hand, posed())[tip]
    assert moved[1] > 0.003


@pytest.mark.parametrize(
    ("name", "direction"),
    [
        ("index_mcp_abduction", 1.0),
        ("middle_mcp_abduction", 1.0),
        ("ring_mcp_abduction", -1.0),
        ("little_mcp_abduction", -1.0),
    ],
)
def test_abduction_moves_a_finger_sideways(hand: ShapedHand, name: str, direction: float) -> None:
    tip = TIP_KEYPOINTS[FINGERS.index(name.split("_")[0])]
    moved = keypoints(hand, posed(**{name: 15.0}))[tip] - keypoints(hand, posed())[tip]
    assert direction * moved[2] > 0.01
    assert abs(moved[1]) < abs(moved[2])


def test_thumb_abduction_lifts_and_flexion_crosses_the_palm(hand: ShapedHand) -> None:
    zero = keypoints(hand, posed())[4]
    lifted = keypoints(hand, posed(thumb_tm_abduction=30.0))[4] - zero
    assert lifted[1] > 0.02
    crossed = keypoints(hand, posed(thumb_tm_flexion=30.0))[4] - zero
    assert crossed[2] < -0.02


def test_zero_angles_are_a_flat_hand_with_straight_fingers(hand: ShapedHand) -> None:
    points = keypoints(hand, posed())
    for finger in range(1, 5):
        chain = np.diff(points[1 + 4 * finger : 5 + 4 * finger], axis=0)
        directions = chain / np.linalg.norm(chain, axis=1, keepdims=True)
        np.testing.assert_allclose(directions, directions[:1].repeat(3, axis=0), atol=1e-9)
        assert abs(directions[0, 1]) < 1e-9
        assert abs(np.degrees(np.arctan2(directions[0, 2], directions[0, 0]))) < 20


def test_fist_brings_the_fingers_together_over_the_palm(hand: ShapedHand) -> None:
    flat = keypoints(hand, posed())
    fist = keypoints(hand, posed(mcp_flexion=80.0, pip_flexion=100.0, dip_flexion=60.0))
    knuckles = flat[5, 2] - flat[17, 2]
    assert fist[8, 2] - fist[20, 2] < 0.85 * knuckles  # tips converge
    for tip in TIP_KEYPOINTS[1:]:
        assert 0.0 < fist[tip, 1] < 0.05
        assert 0.3 < fist[tip, 0] / flat[9, 0] < 1.05
    # Neighbours stay a finger's breadth apart at the middle joint and do not cross.
    joints = fist[[6, 10, 14, 18], 2]
    assert (np.diff(joints) < -0.012).all()


@pytest.mark.parametrize("finger", [1, 2, 3, 4])
def test_thumb_pad_meets_every_fingertip_within_the_limits(hand: ShapedHand, finger: int) -> None:
    free = [k for k, bone in enumerate(ANGLE_BONES) if finger_of_bone(bone) in (0, finger)]
    low, high = hand.limits[free].T
    pad = np.array([-0.009, 0.007, 0.0])  # from the tip: back along the bone, out to the skin

    def pads(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = posed()
        pose[7 + np.array(free)] = angles
        rotations, origins = bone_frames(hand, pose)
        bones = [DISTAL_BONES[0], DISTAL_BONES[finger]]
        points = origins[bones] + np.einsum(
            "bij,bj->bi", rotations[bones], hand.tip_offsets[[0, finger]] + pad
        )
        return points, rotations[bones, :, 1]

    def miss(angles: np.ndarray) -> np.ndarray:
        points, outward = pads(angles)
        return np.concatenate([1e3 * (points[0] - points[1]), 2.0 * outward.sum(axis=0)])

    start = np.clip(np.full(len(free), 0.5), low, high)
    solution = least_squares(miss, start, bounds=(low, high))
    points, outward = pads(solution.x)
    assert np.linalg.norm(points[0] - points[1]) < 0.001
    assert outward[0] @ outward[1] < -0.5  # the pads face each other


def test_shape_space_explains_its_share_with_few_components(arrays: dict[str, np.ndarray]) -> None:
    for name in ("scale_variance", "offset_variance"):
        shares = arrays[name]
        assert (np.diff(shares) <= 0).all()
        assert 0.95 <= shares.sum() <= 1.0
        assert len(shares) <= 20


def test_mean_hand_is_close_to_the_template(model: HandModel) -> None:
    assert np.abs(model.scale_mean - 1.0).max() < 0.05
    assert np.linalg.norm(model.offset_mean, axis=1).max() < 0.003


def test_sampled_hands_are_closed_plausible_and_varied(model: HandModel) -> None:
    rng = np.random.default_rng(5)
    rest = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], model.rest_angles])
    lengths = []
    for _ in range(40):
        hand = model.shaped(model.sample_shape(rng))
        mesh = trimesh.Trimesh(skin(hand, rest), hand.faces, process=False)
        bones = hand.bone_lengths
        lengths.append(bones[[0, 7, 8, 9]].sum())
        assert 120e-6 < mesh.volume < 1000e-6
        assert mesh.is_watertight
        assert (bones[1:] > 0.008).all()
        assert 0.42 < bones[0] / lengths[-1] < 0.60
    # Ten-year-olds to tall men; Greiner (1991) has adults of 156 to 225 mm.
    assert 0.12 < min(lengths) < 0.175
    assert 0.19 < max(lengths) < 0.26
    assert 0.175 < np.mean(lengths) < 0.195


def test_every_parent_comes_before_its_children() -> None:
    assert all(parent < bone for bone, parent in enumerate(BONE_PARENTS))
