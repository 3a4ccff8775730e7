"""Learning from scans as a whole, on hands of the shipped model and spoilt weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.errors import InputError
from handtrack.hand.learning import LearningOptions, LearntHand, Scan, find_scans, learn_hand
from handtrack.hand.learning.posed_template import PosedTemplate, Template
from handtrack.hand.learning.weights import dense_weights, mean_weight_error
from handtrack.hand.model import HandModel

OPTIONS = LearningOptions(rounds=2, first_steps=10, steps=3)
SUBJECTS = 3


@pytest.fixture(scope="module")
def made(model: HandModel, scan_of: Callable) -> dict[str, list]:
    """Scans of three people in two poses, with their truth."""
    rng = np.random.default_rng(7)
    shapes = [model.sample_shape(rng) for _ in range(SUBJECTS)]
    return {
        f"s{k}": [scan_of(shape, pose, 10 * k + n) for n, pose in enumerate(("rest", "bent"))]
        for k, shape in enumerate(shapes)
    }


@pytest.fixture(scope="module")
def learnt(made: dict, blurred: HandModel, poses: dict[str, NDArray]) -> LearntHand:
    scans = {subject: [one.scan(subject) for one in own] for subject, own in made.items()}
    return learn_hand(scans, poses, template=blurred, options=OPTIONS)


def test_surfaces_of_all_scans_are_recovered(learnt: LearntHand, made: dict) -> None:
    template = Template.of(learnt.model)
    for subject, fit in learnt.subjects.items():
        posed = PosedTemplate(template, fit.shape, fit.poses)
        for vertices, truth in zip(posed.vertices, made[subject], strict=True):
            assert truth.away(vertices).mean() < 0.0005


def test_weights_come_nearer_to_the_true_ones(
    learnt: LearntHand, blurred: HandModel, model: HandModel
) -> None:
    truth = dense_weights(model.weight_bones, model.weights)
    before, after = (
        mean_weight_error(dense_weights(m.weight_bones, m.weights), truth)
        for m in (blurred, learnt.model)
    )
    # Three people and two poses say little; docs/learning.md has the figures of sixty.
    assert after < 0.985 * before


def test_residuals_fall_from_step_to_step_and_round_to_round(learnt: LearntHand) -> None:
    first, second = learnt.residuals
    assert first[-1] < 0.3 * first[0]
    assert second[-1] < first[-1]
    assert len(first) == OPTIONS.first_steps + 1 + OPTIONS.steps + 1
    assert len(second) == OPTIONS.steps + 1


def test_the_saved_model_is_a_hand_model(learnt: LearntHand, tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    learnt.save(path, source="three drawn hands", licence="CC0-1.0")
    loaded = HandModel.load(path)
    np.testing.assert_array_equal(loaded.weight_bones, learnt.model.weight_bones)
    np.testing.assert_allclose(loaded.offset_basis, learnt.model.offset_basis)
    hand = loaded.shaped(loaded.sample_shape(np.random.default_rng(0)))
    assert 0.05 < hand.bone_lengths[0] < 0.15


def test_scans_on_disk_give_what_scans_in_memory_give(
    made: dict, blurred: HandModel, poses: dict[str, NDArray], tmp_path: Path
) -> None:
    brief = LearningOptions(rounds=1, first_steps=2, steps=1)
    first = dict(list(made.items())[:2])
    for subject, own in first.items():
        own[0].mesh.export(tmp_path / f"{subject}_rest.ply")
    in_memory = {subject: [own[0].scan(subject)] for subject, own in first.items()}
    told = []
    a = learn_hand(
        find_scans(tmp_path),
        poses,
        template=blurred,
        options=brief,
        progress=lambda *counts: told.append(counts),
    )
    b = learn_hand(in_memory, poses, template=blurred, options=brief)
    for subject in first:  # PLY files hold single precision
        np.testing.assert_allclose(a.subjects[subject].poses, b.subjects[subject].poses, atol=5e-3)
    assert told == [(0, 1, 2), (0, 2, 2)]


def test_one_subject_and_unknown_poses_are_refused_at_once(
    made: dict, poses: dict[str, NDArray]
) -> None:
    scan = Scan.of_mesh(made["s0"][0].mesh, subject="s0", pose="waving")
    with pytest.raises(InputError, match="two subjects"):
        learn_hand({"s0": [scan]}, poses)
    with pytest.raises(InputError, match="'waving' that has no angles; known are bent, rest"):
        learn_hand({"s0": [scan], "s1": [scan]}, poses)


@pytest.mark.parametrize(
    "wrong", [{"rounds": 0}, {"data_std": 0.0}, {"share": 1.5}, {"reach": (0.001, 0.002)}]
)
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="expected"):
        LearningOptions(**wrong)
