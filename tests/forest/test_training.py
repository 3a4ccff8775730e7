"""A tiny forest is learnt: it helps, it follows from its seed, and its learning is gone on with."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.device import resolve_device
from handtrack.forest import row_chunks
from handtrack.forest.artifact import FINGER_KEYPOINTS, PALM_KEYPOINTS, Forest
from handtrack.forest.cascade import Cascade
from handtrack.forest.row_chunks import CropSource
from handtrack.forest.rows import ForestHands
from handtrack.hand.kinematics import keypoints
from handtrack.kernels.forest_features import NSTART

CAMERA_SIZE = (240, 320)


def palm_errors(frames, poses: NDArray) -> NDArray[np.float64]:
    """Mean error of the palm's points of every pose [m], shape (nframe, nmode)."""
    truth = frames.batch.keypoints[:, None, list(PALM_KEYPOINTS)]
    found = np.stack([
        keypoints(hand, of_frame)[:, list(PALM_KEYPOINTS)]
        for hand, of_frame in zip(frames.hands(), poses, strict=True)
    ])  # fmt: skip
    return np.linalg.norm(found - truth, axis=-1).mean(axis=-1)


def finger_errors(frames, poses: NDArray) -> NDArray[np.float64]:
    """Mean error of the fingers' outer joints [m], shape (nframe,)."""
    order = list(FINGER_KEYPOINTS)
    found = np.stack([
        keypoints(hand, pose)[order] for hand, pose in zip(frames.hands(), poses, strict=True)
    ])  # fmt: skip
    return np.linalg.norm(found - frames.batch.keypoints[:, order], axis=-1).mean(axis=-1)


def start_poses(frames, forest: Forest) -> NDArray[np.float64]:
    """The start poses of all frames, shape (nframe, NSTART, 28)."""
    count = len(frames.crops)
    radius = np.full(count, forest.config.gate_radius)
    source = CropSource(
        cells=frames.crops.cells, cameras=frames.crops.cameras, worn=frames.crops.subjects,
        gates=np.column_stack([frames.centres, radius]).astype(np.float32),
        hands=ForestHands.upload(frames.subjects, forest.anchor_vertices, resolve_device("cpu")),
    )  # fmt: skip
    poses = source.start_poses(NSTART, np.random.default_rng(0))
    return poses.reshape(count, NSTART, 28).astype(np.float64)


def cascade_of(frames, forest: Forest, camera) -> Cascade:
    cascade = Cascade(forest, frames.hands(), camera, device="cpu")
    cascade.load(frames.batch.depth, frames.centres)
    return cascade


@pytest.fixture(scope="module")
def camera():
    from handtrack.synthesis.sequence import CAMERAS

    assert CAMERAS["creative"].shape == CAMERA_SIZE
    return CAMERAS["creative"]


def test_all_stages_and_trees_are_there(tiny) -> None:
    forest = tiny.forest
    assert len(forest.palm) == len(forest.fingers) == 2 and not forest.holistic
    for stage in forest.palm:
        assert stage.anchors.shape == (1, 48) and len(stage.roots) == 3
        assert stage.updates.shape[1:] == (2, 6, 3)
        np.testing.assert_allclose(stage.leaf_weights.sum(axis=1), 1.0, atol=1e-6)
    for stage in forest.fingers:
        assert stage.anchors.shape == (5, 48) and stage.updates.shape[1:] == (1, 3, 3)
        np.testing.assert_array_equal(stage.tree_parts, np.repeat(np.arange(5), 3))
    assert forest.presence is not None and len(forest.presence.roots) == 3
    assert all((stage.anchors >= 0).all() for stage in (*forest.palm, *forest.fingers))
    assert len(list(tiny.work.iterdir())) == 39


def test_every_tree_is_told_as_soon_as_it_is_there(tiny) -> None:
    assert [number for number, _ in tiny.reports] == list(range(1, 40))
    words = [word for _, word in tiny.reports]
    assert words[0] == "palm, stage 1" and words[3] == "palm, stage 2"
    assert words[6] == "finger-0, stage 1" and words[-1].startswith("presence")


def test_palms_are_nearer_than_those_that_the_axes_give(frames, tiny, camera) -> None:
    starts = palm_errors(frames, start_poses(frames, tiny.forest))
    poses, weights = cascade_of(frames, tiny.forest, camera).run_palms()
    found = palm_errors(frames, poses)
    assert (weights[:, 0] > 0).all()
    # The heaviest mode against one of the four starts, and the best against the best.
    assert np.median(found[:, 0]) < 0.65 * np.median(starts)
    heard = np.where(weights > 0, found, np.inf).min(axis=1)
    assert np.median(heard) < 0.5 * np.median(starts.min(axis=1))


def test_fingers_bend_towards_the_truth(frames, tiny, camera) -> None:
    poses = frames.batch.poses.copy()
    poses[:, 7:] = [hand.rest_angles for hand in frames.hands()]
    before = finger_errors(frames, poses)
    modes = np.repeat(poses[:, None], tiny.forest.config.modes, axis=1)
    cascade = cascade_of(frames, tiny.forest, camera)
    cascade.run_palms()
    bent = cascade.run_fingers(modes)
    after = finger_errors(frames, bent[:, 0])
    assert np.median(after) < 0.75 * np.median(before)
    np.testing.assert_allclose(bent[:, 0, :3], poses[:, :3], atol=1e-6)
    limits = frames.subjects[0].limits
    assert (bent[..., 7:] >= limits[:, 0] - 1e-6).all()
    assert (bent[..., 7:] <= limits[:, 1] + 1e-6).all()


def test_hands_are_told_from_walls(frames, tiny, camera) -> None:
    cascade = Cascade(tiny.forest, frames.hands(), camera, device="cpu")
    wrists = frames.batch.keypoints[:, 0]
    walls = np.broadcast_to(frames.centres[:, 2, None, None], frames.batch.depth.shape)
    chances = []
    for depth in (frames.batch.depth, walls.astype(np.float32)):
        cascade.load(depth, frames.centres, wrists)
        cascade.run_palms()
        chances.append(cascade.presence())
    assert chances[0].shape == (120,)
    assert (chances[0] > 0.5).mean() > 0.9 and (chances[1] < 0.5).mean() > 0.9


def test_learning_goes_on_from_the_trees_that_are_kept(
    train, regions, tiny, tmp_path: Path, assert_same_forest
) -> None:
    work = tmp_path / "trees"
    shutil.copytree(tiny.work, work)
    paths = sorted(work.iterdir())
    for path in paths:
        os.utime(path, (1.0, 1.0))
    gone = [path for path in paths if "-palm-1-" in path.name or "-finger-2-0-1" in path.name]
    assert len(gone) == 4
    for path in gone:
        path.unlink()
    cut = next(path for path in paths if "-finger-4-1-2" in path.name)
    cut.write_bytes(cut.read_bytes()[:300])
    assert_same_forest(train(work, regions=regions), tiny.forest)
    made = {path for path in work.iterdir() if path.stat().st_mtime > 2.0}
    assert made == {*gone, cut}


def test_trees_of_other_settings_are_not_used(
    train, tiny, tmp_path: Path, assert_same_forest
) -> None:
    changed = {"stages": 1, "seed": 5}
    shutil.copytree(tiny.work, tmp_path / "used")
    one, other = (train(tmp_path / name, **changed) for name in ("used", "fresh"))
    assert_same_forest(one, other)
    assert (one.palm[0].node_points[:5] != tiny.forest.palm[0].node_points[:5]).any()


def test_the_same_seed_gives_the_same_forest_whatever_it_runs_on(
    train, regions, tiny, tmp_path: Path, monkeypatch, assert_same_forest
) -> None:
    monkeypatch.setattr(row_chunks, "CHUNK_FRAMES", 50)
    assert_same_forest(train(tmp_path, regions=regions, threads=3), tiny.forest)


def test_a_holistic_forest_moves_all_joints_at_once(frames, train, tmp_path, camera) -> None:
    forest = train(tmp_path, structure="holistic")
    assert forest.holistic and not forest.fingers and forest.presence is None
    for stage in forest.palm:
        assert stage.updates.shape[1:] == (2, 21, 3)
    cascade = cascade_of(frames, forest, camera)
    poses, _ = cascade.run_palms()
    np.testing.assert_array_equal(cascade.presence(), 1.0)
    np.testing.assert_array_equal(cascade.run_fingers(poses), poses)
    starts = start_poses(frames, forest)
    assert np.median(palm_errors(frames, poses)[:, 0]) < 0.75 * np.median(
        palm_errors(frames, starts)
    )
    assert np.median(finger_errors(frames, poses[:, 0])) < 0.7 * np.median(
        finger_errors(frames, starts[:, 0])
    )


def test_a_pose_indexed_forest_looks_from_the_frames_origins(
    frames, train, tmp_path, camera
) -> None:
    forest = train(tmp_path, features="pose-indexed", stages=1)
    assert all((stage.anchors == -1).all() for stage in (*forest.palm, *forest.fingers))
    poses, _ = cascade_of(frames, forest, camera).run_palms()
    starts = palm_errors(frames, start_poses(frames, forest))
    assert np.median(palm_errors(frames, poses)[:, 0]) < 0.65 * np.median(starts)


def test_learning_works_without_a_wrong_region(train, regions, tmp_path: Path) -> None:
    hands = replace(regions, is_hand=np.ones_like(regions.is_hand))
    forest = train(tmp_path, regions=hands, stages=1, trees=1)
    assert forest.presence is not None
    np.testing.assert_array_equal(forest.presence.updates[..., 0], 1.0)
