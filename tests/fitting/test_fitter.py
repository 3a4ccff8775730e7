"""The fit of one frame: known poses found again, whatever the camera, side, batch or way to run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.errors import DeviceError, InputError
from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.hand.kinematics import keypoints
from handtrack.hand.side import mirror_pose
from handtrack.priors.gaussian import GaussianPrior
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import pose_difference
from oracles.scenes import hand_centre, shaped_hand

MILLIMETRE = 1e-3


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize(
    ("camera", "tolerance"),
    # Errors are of the order of half a cell of the crop.
    [("160x120", 3.0), ("320x240", 1.5), ("640x480", 1.5)],
)
def test_known_poses_are_recovered(make_scene, device, camera, side, tolerance) -> None:
    scene = make_scene(side=side, camera=camera, count=12)
    fitter = scene.fitter(device)
    fitter.run()
    first = scene.keypoint_errors(fitter.poses)
    before = scene.keypoint_errors(scene.start)
    assert before.mean() > 5 * MILLIMETRE
    assert first.mean() < tolerance * MILLIMETRE
    assert first.mean() < 0.35 * before.mean()
    # The fit of the next frame of a still hand starts where this one ended, and stays.
    fitter.set_poses(fitter.poses)
    fitter.run()
    second = scene.keypoint_errors(fitter.poses)
    assert second.mean() < tolerance * MILLIMETRE
    assert (second < 3 * tolerance * MILLIMETRE).all()
    # On few pixels E_d is mostly ragged silhouette: compare with where the hand really is.
    found = fitter.errors
    assert np.median(found) < np.median(scene.depth_errors(device)) + 0.4 * tolerance * MILLIMETRE


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_energy_of_the_thesis_recovers_poses_too(make_scene, device, side) -> None:
    scene = make_scene(side=side, camera="320x240", count=8)
    fitter = scene.fitter(device, config=THESIS)
    for _ in range(3):
        fitter.run()
        fitter.set_poses(fitter.poses)
    # Point-to-point glides slowly along surfaces.
    assert scene.keypoint_errors(fitter.poses).mean() < 3.5 * MILLIMETRE


@pytest.mark.parametrize(
    "changes",
    [
        {"levenberg": True},
        {"silhouette_weight": 0.0, "front_weight": 0.0},
        {"normal_reach": 0},
        {"collision_weight": 1.0},
        {"tangent_weight": 0.1},
        {"point_stride": 1},
    ],
    ids=str,
)
def test_every_switch_still_recovers_poses(make_scene, device, changes) -> None:
    scene = make_scene(camera="320x240", count=8)
    fitter = scene.fitter(device, config=replace(FitConfig(), **changes))
    for _ in range(2):
        fitter.run()
        fitter.set_poses(fitter.poses)
    errors = scene.keypoint_errors(fitter.poses)
    assert np.median(errors) < 2.0 * MILLIMETRE
    assert errors.mean() < 0.5 * scene.keypoint_errors(scene.start).mean()


def test_the_fit_of_a_mirrored_image_is_the_mirrored_pose(make_scene, device) -> None:
    right = make_scene(side="right", camera="320x240", count=6)
    camera = right.camera
    mirrored_camera = replace(camera, cx=camera.width - 1 - camera.cx)
    fitter = right.fitter(device)
    fitter.run()
    mirrored = Fitter([shaped_hand("left", 3)] * 6, mirrored_camera, device=device, threads=1)
    start = mirror_pose(right.start)
    mirrored.load_depth(right.depth[:, :, ::-1])
    mirrored.place(hand_centre(right.hand, right.start) * [-1, 1, 1])
    mirrored.set_poses(start)
    mirrored.run()
    expected = keypoints(shaped_hand("left", 3), mirror_pose(fitter.poses.astype(np.float64)))
    found = keypoints(shaped_hand("left", 3), mirrored.poses.astype(np.float64))
    # Sampling starts at the left border in both images, so other pixels are taken.
    assert np.linalg.norm(found - expected, axis=-1).mean() < 0.6 * MILLIMETRE
    # A pixel more or less of the outline weighs up to the score's cap.
    np.testing.assert_allclose(mirrored.errors, fitter.errors, atol=2.5 * MILLIMETRE)


@pytest.mark.parametrize("levenberg", [False, True])
def test_one_row_equals_the_same_row_in_a_batch_of_seven(
    make_scene, device, quick_config, levenberg
) -> None:
    scene = make_scene(count=7)
    config = replace(quick_config, levenberg=levenberg)
    batch = scene.fitter(device, config=config)
    batch.run()
    for index in (0, 3, 6):
        alone = Fitter([scene.hand], scene.camera, config=config, device=device)
        alone.load_depth(scene.depth[index])
        # The batch of seven hands lays its crops in the same arithmetic.
        alone.place(hand_centre(scene.hand, scene.start)[index])
        alone.set_poses(scene.start[index])
        alone.run()
        np.testing.assert_array_equal(alone.poses[0], batch.poses[index])
        np.testing.assert_array_equal(alone.errors[0], batch.errors[index])


def test_hypotheses_of_one_image_do_not_mix(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    other = make_scene(count=7)
    starts = np.concatenate([scene.start, other.start[1:]])
    together = scene.fitter(device, config=quick_config, nhyp=7)
    together.set_poses(starts)
    together.run()
    alone = scene.fitter(device, config=quick_config)
    for row in range(7):
        alone.set_poses(starts[row])
        alone.run()
        np.testing.assert_array_equal(alone.poses[0], together.poses[row])
        np.testing.assert_array_equal(alone.errors[0], together.errors[row])
    # The start next to the truth ends with the lowest depth error.
    assert together.errors.argmin() == 0


@pytest.mark.parametrize(
    "config", [FitConfig(), FitConfig(levenberg=True, collision_weight=1.0), THESIS],
    ids=["default", "levenberg", "thesis"],
)  # fmt: skip
def test_eager_equals_captured_in_every_frame(make_scene, device, config) -> None:
    scene = make_scene(count=3)
    eager = scene.fitter(device, config=config, graph=False)
    captured = scene.fitter(device, config=config, graph=True)
    depths = [scene.depth, scene.depth[::-1], scene.depth * (scene.depth < 0.45), scene.depth]
    for frame, depth in enumerate(depths):
        results = []
        for fitter in (eager, captured):
            fitter.load_depth(np.ascontiguousarray(depth))
            fitter.place(hand_centre(scene.hand, scene.start) + 0.001 * frame)
            fitter.set_poses(scene.start)
            fitter.run()
            results.append((fitter.poses, fitter.errors))
        np.testing.assert_array_equal(results[0][0], results[1][0], err_msg=f"frame {frame}")
        np.testing.assert_array_equal(results[0][1], results[1][1], err_msg=f"frame {frame}")


def test_a_frame_does_not_depend_on_the_frames_before(make_scene, device, quick_config) -> None:
    scene = make_scene(count=3)
    for levenberg in (False, True):
        config = replace(quick_config, levenberg=levenberg)
        used = scene.fitter(device, config=config)
        for depth, start in (
            (scene.depth[::-1], scene.start[::-1]),
            (np.full_like(scene.depth, np.nan), np.full_like(scene.start, np.nan)),
        ):
            used.load_depth(np.ascontiguousarray(depth))
            used.set_poses(start)
            used.run()
        used.load_depth(scene.depth)
        used.set_poses(scene.start)
        used.run()
        fresh = scene.fitter(device, config=config)
        fresh.run()
        np.testing.assert_array_equal(used.poses, fresh.poses)
        np.testing.assert_array_equal(used.errors, fresh.errors)


def test_nothing_is_allocated_in_the_second_frame(make_scene, device, no_allocation) -> None:
    import warp as wp

    scene = make_scene(count=2)
    config = FitConfig(levenberg=True, collision_weight=1.0, tangent_weight=0.1)
    for graph in (True, False):
        fitter = scene.fitter(device, config=config, graph=graph)
        fitter.run()
        with no_allocation(device):
            with pytest.raises(AssertionError, match="Warp allocated"):
                wp.zeros(3, dtype=float, device=device)
            fitter.load_depth(scene.depth)
            fitter.place(hand_centre(scene.hand, scene.start))
            fitter.set_smoothness(0.3)
            fitter.set_poses(scene.start, scene.truth)
            fitter.run()
            poses, errors = fitter.poses, fitter.errors
        assert np.isfinite(poses).all() and np.isfinite(errors).all()


GARBAGE_STARTS = {
    "nan": np.full(28, np.nan),
    "one nan": np.where(np.arange(28) == 9, np.nan, 0.1),
    "infinite": np.full(28, np.inf),
    "huge": np.full(28, 1e30),
    "zeros": np.zeros(28),
    "no rotation": np.concatenate([[0, 0, 0.5], np.zeros(25)]),
    "behind the camera": np.concatenate([[0, 0, -0.5, 1, 0, 0, 0], np.zeros(21)]),
    "at the camera": np.concatenate([[0, 0, 0.0, 1, 0, 0, 0], np.zeros(21)]),
    "wild angles": np.concatenate([[0, 0, 0.5, 1, 0, 0, 0], np.full(21, 1e4)]),
}


@pytest.mark.parametrize("kind", GARBAGE_STARTS)
@pytest.mark.parametrize("levenberg", [False, True])
def test_a_garbage_start_harms_no_other_row(
    make_scene, device, quick_config, kind, levenberg
) -> None:
    scene = make_scene(count=1)
    config = replace(quick_config, levenberg=levenberg, collision_weight=1.0)
    good = scene.fitter(device, config=config, nhyp=3)
    good.run()
    fitter = scene.fitter(device, config=config, nhyp=3)
    starts = np.repeat(scene.start, 3, axis=0)
    starts[1] = GARBAGE_STARTS[kind]
    with np.errstate(over="ignore"):
        fitter.set_poses(starts)
    fitter.run()
    np.testing.assert_array_equal(fitter.poses[[0, 2]], good.poses[[0, 2]])
    assert np.isfinite(fitter.errors).all()
    # Its error says that it is no candidate.
    assert fitter.errors[1] > fitter.errors[0]


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 1e30, 1e-6, 0.45, 5.0])
def test_an_image_without_a_hand_leaves_a_finite_pose(
    make_scene, device, quick_config, value
) -> None:
    scene = make_scene(count=2)
    fitter = scene.fitter(device, config=quick_config)
    fitter.load_depth(np.full_like(scene.depth, value))
    fitter.run()
    assert np.isfinite(fitter.poses).all() and np.isfinite(fitter.errors).all()
    np.testing.assert_allclose(np.linalg.norm(fitter.poses[:, 3:7], axis=1), 1.0, atol=1e-5)
    if not (0.01 < value < 1):
        # Nothing to see: no error measured, or the largest.
        np.testing.assert_allclose(fitter.errors, quick_config.score_cap, rtol=1e-6)
    # The next good frame is fitted as ever.
    fitter.load_depth(scene.depth)
    fitter.set_poses(scene.start)
    fitter.run()
    assert scene.keypoint_errors(fitter.poses).mean() < 4 * MILLIMETRE


@pytest.mark.parametrize(
    "centre", [[0, 0, 0], [0, 0, -1], [1e6, 0, 0.5], [np.nan] * 3, [np.inf, 0, 1]], ids=str
)
def test_a_crop_anywhere_gives_a_finite_pose(make_scene, device, quick_config, centre) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter(device, config=quick_config)
    with np.errstate(all="ignore"):
        fitter.place(np.array(centre, float))
        fitter.run()
    assert np.isfinite(fitter.poses).all() and np.isfinite(fitter.errors).all()


def test_without_data_the_pose_goes_to_the_reference(make_scene, device, quick_config) -> None:
    scene = make_scene(count=2)
    fitter = scene.fitter(device, config=replace(quick_config, iterations=40, damping=0.0))
    fitter.load_depth(np.zeros_like(scene.depth))
    # The silhouette pulls nowhere in an empty image, smoothness to the reference.
    fitter.set_poses(scene.start, scene.truth)
    fitter.run()
    left = np.abs(pose_difference(fitter.poses, scene.truth)).max()
    assert left < 0.05 * np.abs(pose_difference(scene.start, scene.truth)).max()


def test_smoothness_can_be_changed_between_frames(make_scene, device, quick_config) -> None:
    scene = make_scene(count=2)
    moved = []
    fitter = scene.fitter(device, config=quick_config)
    for weight in (1e7, 0.2, 1e7):
        fitter.set_smoothness(weight)
        fitter.set_poses(scene.start)
        fitter.run()
        moved.append(np.abs(pose_difference(fitter.poses, scene.start)).max())
    assert moved[0] < 1e-3 and moved[1] > 0.02
    assert moved[2] == moved[0]


def test_joints_beyond_their_limits_come_back(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter(device, config=replace(quick_config, iterations=8))
    bent = scene.start.copy()
    low, high = scene.hand.limits.T
    bent[0, 7:] = np.where(np.arange(21) % 2, low - 0.3, high + 0.3)
    fitter.load_depth(np.zeros_like(scene.depth))
    fitter.set_poses(bent)
    fitter.run()
    angles = fitter.poses[0, 7:]
    assert (angles > low - 0.02).all() and (angles < high + 0.02).all()


def test_the_prior_pulls_to_its_mean(make_scene, device, quick_config, rng) -> None:
    scene = make_scene(count=1)
    samples = 0.4 + 0.1 * rng.standard_normal((200, 21))
    prior = GaussianPrior.learn(samples)
    config = replace(quick_config, prior_weight=1.0, iterations=20, limit_weight=0.0)
    fitter = scene.fitter(device, config=config, prior=prior)
    fitter.load_depth(np.zeros_like(scene.depth))
    fitter.run()
    np.testing.assert_allclose(fitter.poses[0, 7:], prior.mean, atol=0.02)


def test_collisions_push_crossed_fingers_apart(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    gaps = []
    for weight in (0.0, 10.0):
        config = replace(quick_config, collision_weight=weight, iterations=10, smooth_weight=0.01)
        fitter = scene.fitter(device, config=config)
        crossed = scene.start.copy()
        crossed[0, 7:] = scene.hand.rest_angles
        crossed[0, 7 + 6], crossed[0, 7 + 10] = -0.25, 0.25
        fitter.load_depth(np.zeros_like(scene.depth))
        fitter.set_poses(crossed)
        fitter.run()
        points = keypoints(scene.hand, fitter.poses[0].astype(np.float64))
        gaps.append(np.linalg.norm(points[8] - points[12]))
    assert gaps[1] > gaps[0] + 2 * MILLIMETRE


def test_a_forearm_in_view_does_not_drag_the_hand(make_scene, device) -> None:
    scene = make_scene(camera="320x240", count=6)
    # An elbow well beyond the wrist, the arm in the image down to its border.
    wrist = scene.truth[:, :3]
    elbows = wrist + np.array([0.03, 0.2, 0.05])
    renderer = DepthRenderer(scene.hand, scene.camera, device="cpu", batch=2)
    with_arm = renderer.render(scene.truth, elbows=elbows)
    assert ((with_arm > 0).sum() - (scene.depth > 0).sum()) / 6 > 300
    fitter = scene.fitter(device)
    fitter.load_depth(with_arm)
    for _ in range(2):
        fitter.run()
        fitter.set_poses(fitter.poses)
    assert scene.keypoint_errors(fitter.poses).mean() < 2 * MILLIMETRE


def test_the_depth_error_tells_better_poses_from_worse(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    shifts = np.array([0.0, 0.005, 0.01, 0.02, 0.04, 0.5])
    poses = np.repeat(scene.truth, len(shifts), axis=0)
    poses[:, 0] += shifts
    fitter = scene.fitter(device, config=replace(quick_config, iterations=0), nhyp=len(shifts))
    fitter.set_poses(poses)
    fitter.run()
    assert (np.diff(fitter.errors) > 0).all()
    assert fitter.errors[0] < 3 * MILLIMETRE
    assert fitter.errors[-1] == pytest.approx(quick_config.score_cap, rel=1e-3)
    np.testing.assert_allclose(fitter.poses, poses, atol=1e-6)


def test_the_crop_is_never_finer_than_the_image(make_scene, device) -> None:
    scene = make_scene(count=1)
    for distance in (0.2, 0.45, 2.0, 20.0):
        fitter = scene.fitter(device)
        fitter.place([0.0, 0.0, distance])
        crop = fitter.image.crops.numpy()[0]
        assert crop[6] >= 1.0
        span = fitter.config.crop_cells * distance / crop[0]
        assert span >= fitter.config.crop_span * (1 - 1e-5)
        # The middle of the crop looks at the centre.
        middle = (fitter.config.crop_cells - 1) / 2
        np.testing.assert_allclose(crop[2:4], middle, atol=1e-2)


def test_results_are_copies(make_scene, device, quick_config) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter(device, config=quick_config)
    fitter.run()
    poses, errors = fitter.poses, fitter.errors
    kept = poses.copy()
    fitter.set_poses(np.zeros(28))
    np.testing.assert_array_equal(poses, kept)
    poses[:] = 0
    errors[:] = 0
    assert fitter.errors.any()


def test_what_cannot_be_built_is_told(make_scene) -> None:
    scene = make_scene(count=1)
    hand, camera = scene.hand, scene.camera
    with pytest.raises(InputError, match="0 hands"):
        Fitter([], camera, device="cpu")
    with pytest.raises(InputError, match="0 hypotheses"):
        Fitter([hand], camera, nhyp=0, device="cpu")
    with pytest.raises(InputError, match="GaussianPrior"):
        Fitter([hand], camera, config=FitConfig(prior_weight=1.0), device="cpu")
    with pytest.raises(DeviceError, match="this machine has"):
        Fitter([hand], camera, device="cuda:99")


def test_hands_of_both_sides_in_one_fitter_are_told(make_scene) -> None:
    scene = make_scene(count=1)
    hands = [shaped_hand("right", 1), shaped_hand("left", 1)]
    with pytest.raises(InputError, match="side"):
        Fitter(hands, scene.camera, device="cpu")


def test_arrays_of_another_shape_are_told(make_scene, quick_config) -> None:
    scene = make_scene(count=1)
    fitter = scene.fitter("cpu", config=quick_config)
    height, width = scene.camera.shape
    # A turned image has as many pixels, and would be read as stripes.
    for shape in ((width, height), (height, width + 1), (2, height, width), (height * width,)):
        with pytest.raises(InputError, match="depth"):
            fitter.load_depth(np.zeros(shape, np.float32))
    for shape in ((27,), (2, 28), (28, 2)):
        with pytest.raises(InputError, match="pose"):
            fitter.set_poses(np.zeros(shape))
    with pytest.raises(InputError, match=r"pose|reference"):
        fitter.set_poses(np.zeros(28), np.zeros(27))
    with pytest.raises(InputError, match="centre"):
        fitter.place(np.zeros((2, 3)))


def test_a_wide_camera_and_a_tiny_one_work(make_scene, device) -> None:
    scene = make_scene(count=1)
    for camera in (
        Camera(width=64, height=48, fx=48.0, fy=48.0, cx=31.5, cy=23.5),
        Camera(width=17, height=300, fx=100.0, fy=200.0, cx=8.0, cy=150.0),
    ):
        depth = DepthRenderer(scene.hand, camera, device="cpu", batch=1).render(scene.truth)
        fitter = Fitter([scene.hand], camera, device=device)
        fitter.load_depth(depth)
        fitter.place(hand_centre(scene.hand, scene.truth))
        fitter.set_poses(scene.truth)
        fitter.run()
        assert np.isfinite(fitter.poses).all() and np.isfinite(fitter.errors).all()
