"""The deviation of keypoints: known covariances come out, and what was seen badly grows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.fitting.uncertainty import (
    CORRELATION_LENGTH,
    FLOOR,
    OUTLINE,
    PALM_RANGE,
    FitInformation,
    keypoint_deviation,
)
from handtrack.hand.kinematics import keypoints
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import apply_increment, matrix_to_quat, rotvec_to_matrix
from oracles.scenes import SMALL_CAMERA, hand_centre, seen_poses, shaped_hand

MILLIMETRE = 1e-3


def known(hessian: np.ndarray, scale: float) -> FitInformation:
    """Points far enough apart to count fully, with residuals of a scale [m]."""
    area = 0.01
    return FitInformation(
        hessian=hessian, unexplained=np.sqrt(scale * OUTLINE / area), area=area,
        spacing=CORRELATION_LENGTH,
    )  # fmt: skip


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_quadratic_gives_its_covariance(side: str, rng: np.random.Generator) -> None:
    """Increments drawn from s^2 H^-1 move the keypoints as far as the deviation says."""
    hand = shaped_hand(side, 2)
    pose = seen_poses(hand, rng, 1, bend=1.0)[0]
    # An information of some hundred points that fixes everything to fractions of a degree.
    mixed = rng.normal(size=(400, 27)) * np.repeat([1.0, 0.05, 0.03], [3, 3, 21])
    hessian, scale = mixed.T @ mixed, 0.002
    draws = rng.multivariate_normal(np.zeros(27), scale**2 * np.linalg.inv(hessian), size=20000)
    poses = apply_increment(np.repeat(pose[None], len(draws), axis=0), draws)
    moved = np.linalg.norm(keypoints(hand, poses) - keypoints(hand, pose), axis=-1)
    common = scale**2 + FLOOR**2
    found = keypoint_deviation(hand, pose, known(hessian, scale))
    # 20000 draws tell a standard deviation to half a percent; five of those.
    np.testing.assert_allclose(found, np.sqrt((moved**2).mean(0) + common), rtol=0.025)


def test_translation_alone_is_the_same_for_all_keypoints(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    hessian = np.diag(np.repeat([4.0, 1e9], [3, 24]))
    found = keypoint_deviation(hand, pose, known(hessian, 0.002))
    expected = np.sqrt(3 * 0.002**2 / 4 + 0.002**2 + FLOOR**2)
    # The weak prior on the palm's place is 0.1 m.
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_points_that_lie_closer_do_not_count_more(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    hessian = np.diag(np.repeat([100.0, 1.0, 0.1], [3, 3, 21]))
    base = known(hessian, 0.002)
    # Twice as dense in both directions: four times the points on the same surface.
    dense = replace(base, hessian=4 * hessian, spacing=base.spacing / 2)
    apart = replace(base, spacing=10 * base.spacing)
    expected = keypoint_deviation(hand, pose, base)
    np.testing.assert_allclose(keypoint_deviation(hand, pose, dense), expected, rtol=1e-9)
    np.testing.assert_allclose(keypoint_deviation(hand, pose, apart), expected, rtol=1e-9)


def test_worse_residuals_make_everything_less_certain(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    hessian = np.diag(np.repeat([100.0, 1.0, 0.1], [3, 3, 21]))
    base = FitInformation(hessian=hessian, unexplained=0.0, area=0.01, spacing=0.004)
    found = np.array([
        keypoint_deviation(hand, pose, replace(base, unexplained=share))
        for share in (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)
    ])  # fmt: skip
    assert (np.diff(found, axis=0) >= 0).all() and (np.diff(found[1:], axis=0) > 0).all()
    assert (found[0] > FLOOR).all()


def test_what_was_not_seen_is_as_uncertain_as_its_range(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    nothing = keypoint_deviation(hand, pose, known(np.zeros((27, 27)), 0.001))
    assert np.isfinite(nothing).all() and (nothing > PALM_RANGE[0]).all()
    # The palm is known, and one finger after the other is not.
    full = np.diag(np.repeat([1e6, 1e4, 1e4], [3, 3, 21]))
    seen = keypoint_deviation(hand, pose, known(full, 0.001))
    for finger in range(1, 5):
        angles = slice(6 + 1 + 4 * finger, 6 + 5 + 4 * finger)
        hidden = full.copy()
        hidden[angles] = 0.0
        found = keypoint_deviation(hand, pose, known(hidden, 0.001))
        joints = np.arange(2 + 4 * finger, 5 + 4 * finger)
        assert (found[joints] > 10 * seen[joints]).all()
        assert (np.diff(found[joints]) > 0).all(), "less certain towards the tip"
        others = np.delete(np.arange(21), joints)
        np.testing.assert_allclose(found[others], seen[others], rtol=1e-6)
        assert found.max() < 0.15, "no farther than a finger is long"


def test_numbers_that_are_not_finite_give_nan(rng: np.random.Generator) -> None:
    hand = shaped_hand()
    pose = seen_poses(hand, rng, 1)[0]
    broken = np.eye(27)
    broken[3, 3] = np.nan
    assert np.isnan(keypoint_deviation(hand, pose, known(broken, 0.001))).all()
    found = keypoint_deviation(hand, pose, replace(known(np.eye(27), 0.001), unexplained=np.nan))
    assert np.isnan(found).all()


# What the fitter hands over


def test_information_is_the_undamped_system_without_smoothness(make_scene, device) -> None:
    scene = make_scene(count=1)
    found = []
    for smooth in (0.0, 5.0):
        # One step from the same pose: smoothness adds to the system, and is taken out again.
        config = FitConfig(crop_cells=64, iterations=1, smooth_weight=smooth, damping=1.0)
        fitter = scene.fitter(device, config=config)
        fitter.run()
        found.append(fitter.information(0))
    plain, smoothed = (information.hessian for information in found)
    assert np.linalg.eigvalsh(plain)[-1] > 0
    # float32 sums of a thousand points.
    np.testing.assert_allclose(smoothed, plain, atol=1e-6 * plain.max())
    rows = fitter.rows.rows.numpy()[0][fitter.rows.chains.numpy()[0] >= 0]
    np.testing.assert_allclose(
        plain[:6, :6], rows[:, :6].T.astype(np.float64) @ rows[:, :6] / 1e4,
        atol=1e-5 * plain[:6, :6].max(),
    )  # fmt: skip


def test_information_tells_what_is_seen_of_which_row(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter(device, config=quick_config, nhyp=3)
    poses = np.repeat(scene.truth, 3, axis=0)
    poses[1, 0] += 0.01
    poses[2, 0] += 0.5
    fitter.set_poses(poses)
    fitter.run()
    near, _, far = (fitter.information(row) for row in range(3))
    assert near.unexplained == pytest.approx(fitter.errors[0] / quick_config.score_cap, rel=1e-5)
    # A hand shows between 50 and 200 cm^2.
    assert 0.005 < near.area < 0.02
    assert near.spacing == pytest.approx(2 * 0.27 / 64, rel=1e-6)
    # A row that meets no depth knows nothing but its limits.
    assert far.unexplained == pytest.approx(1.0, rel=1e-3)
    assert not far.hessian[:6, :6].any()
    assert (keypoint_deviation(scene.hand, poses[2], far) > 0.1).all()
    assert keypoint_deviation(scene.hand, fitter.poses[0], near).max() < 0.03


def test_information_is_a_copy_and_allocates_nothing_on_the_device(
    make_scene, device, quick_config, no_allocation
) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter(device, config=quick_config)
    fitter.run()
    if device == "cpu":
        with no_allocation(device):
            information = fitter.information(0)
    else:
        # Copies to the host need host memory; `no_allocation` refuses that too.
        information = fitter.information(0)
    kept = information.hessian.copy()
    fitter.set_poses(apply_increment(scene.truth, np.full((1, 27), 0.02)))
    fitter.run()
    assert not np.array_equal(fitter.information(0).hessian, kept)
    np.testing.assert_array_equal(information.hessian, kept)


@pytest.mark.parametrize(
    "changes", [{"levenberg": True}, {"point_weight": 0.5}, {"point_stride": 1}], ids=str
)
def test_how_the_fit_is_run_changes_the_deviation_little(
    make_scene, device, quick_config, changes
) -> None:
    scene = make_scene(count=1, camera="320x240")
    found = []
    for config in (quick_config, replace(quick_config, **changes)):
        fitter = scene.fitter(device, config=config)
        for _ in range(2):
            fitter.run()
            fitter.set_poses(fitter.poses)
        fitter.run()
        found.append(keypoint_deviation(scene.hand, fitter.poses[0], fitter.information(0)))
    assert np.median(found[1] / found[0]) == pytest.approx(1.0, abs=0.3)


def test_point_to_point_and_no_iterations_work_too(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    for config in (replace(THESIS, crop_cells=64), replace(quick_config, iterations=0)):
        fitter = scene.fitter(device, config=config)
        fitter.run()
        found = keypoint_deviation(scene.hand, fitter.poses[0], fitter.information(0))
        assert np.isfinite(found).all() and (found > FLOOR).all()


def test_a_finger_behind_others_is_less_certain(device, rng: np.random.Generator) -> None:
    hand = shaped_hand()
    # Seen from the thumb's side, index finger in front, and from the palm.
    edge_on = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    deviations = []
    for turn in (np.zeros(3), np.array([np.pi / 2, 0.0, 0.0])):
        pose = np.zeros(28)
        pose[3:7] = matrix_to_quat(edge_on @ rotvec_to_matrix(turn))
        pose[:3] = [0.0, 0.0, 0.45] - keypoints(hand, pose).mean(0)
        fitter = Fitter([hand], SMALL_CAMERA, device=device)
        fitter.load_depth(DepthRenderer(hand, SMALL_CAMERA, device=device).render(pose))
        fitter.place(hand_centre(hand, pose))
        fitter.set_poses(pose)
        fitter.run()
        deviations.append(keypoint_deviation(hand, pose, fitter.information(0)))
    side, front = deviations
    # From the side the little finger is in front and hides the index finger.
    assert side[8] > 2 * side[20]
    assert side[8] > 2 * front[8]


def test_the_mirrored_hand_is_as_uncertain(make_scene, device) -> None:
    right = make_scene(side="right", camera="320x240", count=2)
    camera = replace(right.camera, cx=right.camera.width - 1 - right.camera.cx)
    fitter = right.fitter(device)
    fitter.run()
    left = shaped_hand("left", 3)
    mirrored = Fitter([left] * 2, camera, device=device, threads=1)
    mirrored.load_depth(right.depth[:, :, ::-1])
    mirrored.place(hand_centre(right.hand, right.start) * [-1, 1, 1])
    mirrored.set_poses(mirror_pose(right.start))
    mirrored.run()
    for row in range(2):
        information = fitter.information(row)
        pose = fitter.poses[row].astype(np.float64)
        expected = keypoint_deviation(right.hand, pose, information)
        # Exactly, when the information is mirrored.
        flip = np.concatenate([[-1, 1, 1], [-1, -1, 1], np.ones(21)])
        same = replace(information, hessian=information.hessian * np.outer(flip, flip))
        np.testing.assert_allclose(
            keypoint_deviation(left, mirror_pose(pose), same), expected, rtol=1e-9
        )
        # Nearly, when the image is: other pixels are sampled.
        found = keypoint_deviation(left, mirrored.poses[row], mirrored.information(row))
        assert np.median(found / expected) == pytest.approx(1.0, abs=0.15)
