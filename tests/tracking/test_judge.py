"""The judge: learning, files, and what the shipped one says."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.scenery import DepthScene
from handtrack.tracking.judge import HandJudge, JudgeModel
from handtrack.tracking.likeness import FEATURES
from oracles.scenes import shaped_hand

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)
COUNT = 2 + len(FEATURES)


def judged_poses(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    right = rng.random(count) < 0.5
    features = rng.normal(size=(count, COUNT))
    features[:, 1] += 2.0 * right
    features[:, 5] += 6.0 * right
    return features, right


def test_it_tells_apart_what_it_has_learnt_to() -> None:
    features, right = judged_poses()
    model = JudgeModel.learn(features[:200], right[:200])
    placed = model.log_odds(features[200:]) > 0
    alone = model.log_odds(features[200:], placed=False) > 0
    assert (placed == right[200:]).mean() > 0.97
    assert 0.9 < (alone == right[200:]).mean() <= (placed == right[200:]).mean()


def test_without_a_place_its_presence_does_not_matter() -> None:
    features, right = judged_poses()
    model = JudgeModel.learn(features, right)
    other = features.copy()
    other[:, 1] = 7.0
    np.testing.assert_allclose(
        model.log_odds(features, placed=False), model.log_odds(other, placed=False)
    )
    assert np.abs(model.log_odds(features) - model.log_odds(other)).max() > 0.5


def test_nothing_to_compare_is_no_hand() -> None:
    features, right = judged_poses()
    features[3, 4] = np.nan
    assert JudgeModel.learn(features[4:], right[4:]).log_odds(features[3]) == -np.inf


def test_learning_needs_both_kinds() -> None:
    features, right = judged_poses()
    with pytest.raises(InputError, match="some of both"):
        JudgeModel.learn(features, np.ones_like(right))
    with pytest.raises(InputError, match="expected"):
        JudgeModel.learn(features[:, 1:], right)


def test_files_hold_it(tmp_path) -> None:
    features, right = judged_poses()
    model = JudgeModel.learn(features, right)
    model.save(tmp_path / "judge.npz", source="a test")
    again = JudgeModel.load(tmp_path / "judge.npz")
    np.testing.assert_array_equal(again.log_odds(features), model.log_odds(features))


def test_bad_files_are_told(tmp_path) -> None:
    with pytest.raises(MissingFileError):
        JudgeModel.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no judge")
    with pytest.raises(DamagedFileError, match="not a judge"):
        JudgeModel.load(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", format_version=1, features=np.array(["a", "b", "c"]))
    with pytest.raises(DamagedFileError, match="other features"):
        JudgeModel.load(tmp_path / "other.npz")


def test_the_shipped_judge_knows_a_hand_from_a_smooth_body() -> None:
    hand = shaped_hand("right", 3)
    pose = np.zeros(28)
    pose[:3] = 0.0, 0.08, 0.5
    pose[3:7] = 0.5, -0.5, 0.5, -0.5
    pose[7:] = 0.4
    depth = DepthRenderer(hand, CAMERA, device="cpu").render(pose)[0]
    judge = HandJudge(hand, CAMERA, device="cpu")
    placed, followed = (judge.log_odds(depth, pose, 0.004, place) for place in (0.6, None))
    assert placed > 1.0 and followed > 1.0
    pose[7:] = 1.2
    scene = DepthScene(CAMERA)
    middle = keypoints(hand, pose).mean(axis=0)
    scene.add_ellipsoid(
        middle + np.array([0.0, 0.0, 0.02]), np.eye(3), np.array([0.045, 0.055, 0.04])
    )
    assert judge.log_odds(scene.depth, pose, 0.011, 0.3) < -1.0
    # Not asked what the place looks like, a lone smooth body leaves the judge undecided at most.
    assert judge.log_odds(scene.depth, pose, 0.011) < min(0.5, followed - 3.0)
