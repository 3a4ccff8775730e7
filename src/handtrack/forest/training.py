"""Training the cascades, stage by stage, going on where an earlier run stopped (thesis II.4)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.device import resolve_device
from handtrack.files import UNREADABLE, whole_file
from handtrack.forest.artifact import (
    FINGER_KEYPOINTS,
    PALM_KEYPOINTS,
    Forest,
    ForestStage,
    join_trees,
)
from handtrack.forest.config import TrainingConfig
from handtrack.forest.crops import DEPTH_UNIT, UNKNOWN, TrainingCrops
from handtrack.forest.growing import VALUE_STEP, Samples, grow_tree
from handtrack.forest.reference_points import draw_points, spread_vertices
from handtrack.forest.rows import (
    FINGER_PARTS,
    NFINGER,
    PALM_PART,
    DeviceStage,
    FingerMoves,
    ForestHands,
    ForestImages,
    PalmVotes,
    StageRows,
    launch_starts,
)
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.skeleton import NKEYPOINT
from handtrack.kernels.forest_features import NSTART
from handtrack.transforms import apply_increment, quat_to_matrix

CHUNK_FRAMES = 512
"""Frames whose rows are on the device at a time."""

_BAG, _POINTS, _GATES, _STARTS, _SHAKE, _TREE = 1, 2, 3, 4, 5, 6
"""Streams of random numbers, apart from each other."""

Report = Callable[[int, str], None]
"""Told after every tree: trees done, and what is being done."""


class ForestTrainer:
    """Learns a forest from crops; every tree is kept in the work folder as soon as it is grown."""

    def __init__(
        self,
        config: TrainingConfig,
        crops: TrainingCrops,
        subjects: list[ShapedHand],
        work: Path,
        *,
        device: str | None = None,
        threads: int = 1,
    ) -> None:
        """Prepare.

        Args:
            config: What to learn.
            crops: Labelled crops.
            subjects: Right hands that `crops.subjects` counts.
            work: Folder of unfinished work; trees in it that belong to `config` are used again.
            device: "cpu", "cuda:N" or None for the best there is.
            threads: Trees grown at a time.
        """
        self.config, self.crops, self.subjects = config, crops, subjects
        self._work, self._threads = work, threads
        self._device = resolve_device(device)
        model = HandModel.load()
        self._mean_hand = model.shaped()
        self._anchors = spread_vertices(self._mean_hand)
        self._hands = ForestHands.upload(subjects, self._anchors, self._device)
        self._fingerprint = hashlib.sha256(
            json.dumps(asdict(config), sort_keys=True).encode()
            + np.ascontiguousarray(crops.poses).tobytes()
        ).hexdigest()[:16]
        self._truth = np.empty((len(crops), NKEYPOINT, 3), np.float32)
        for subject, hand in enumerate(subjects):
            mine = crops.subjects == subject
            self._truth[mine] = keypoints(hand, crops.poses[mine])
        self._gates = self._draw_gates()
        forest = config.forest
        finger_trees = 0 if forest.structure == "holistic" else NFINGER * forest.trees
        self.tree_count = forest.stages * (forest.trees + finger_trees)
        """Trees in all."""
        work.mkdir(parents=True, exist_ok=True)

    def run(self, report: Report = lambda *_: None) -> Forest:
        """Train all stages.

        Args:
            report: Told after every tree.
        """
        forest = self.config.forest
        self._done, self._report = 0, report
        holistic = forest.structure == "holistic"
        palm = tuple(self._train_palm(holistic))
        fingers = () if holistic else tuple(self._train_fingers())
        return Forest(config=forest, anchor_vertices=self._anchors, palm=palm, fingers=fingers)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.config.seed, *stream])

    def _draw_gates(self) -> NDArray[np.float32]:
        """Where the hand is expected: about what is seen of it, some way down the forearm."""
        config, rng = self.config, self._rng(_GATES)
        count = len(self.crops)
        rotation = quat_to_matrix(self.crops.poses[:, 3:7])
        centre = self._truth.mean(axis=1)
        slip = rng.uniform(-0.25, 1.0, (count, 1)) * config.forearm_shift
        centre = centre - slip * rotation[..., 0]
        centre = centre + rng.normal(0.0, config.centre_spread, (count, 3))
        gates = np.column_stack([centre, np.full(count, config.forest.gate_radius)])
        return gates.astype(np.float32)

    def _bags(self, name: str, stage: int) -> NDArray[np.bool_]:
        """Which frames each tree learns from, shape (ntree, nframe)."""
        rng = self._rng(_BAG, stage, len(name))
        shape = (self.config.forest.trees, len(self.crops))
        return rng.random(shape) < self.config.forest.bag

    # Palm, or the whole hand at once.

    def _train_palm(self, holistic: bool) -> Iterator[ForestStage]:
        """Cascade of the palm, each stage on what the ones before leave over."""
        config, forest = self.config, self.config.forest
        name = "hand" if holistic else "palm"
        order = [*PALM_KEYPOINTS, *(FINGER_KEYPOINTS if holistic else ())]
        per_frame = min(config.starts, NSTART)
        frames = np.repeat(np.arange(len(self.crops)), per_frame)
        poses = self._start_poses(per_frame)
        for stage in range(forest.stages):
            anchors, offsets = draw_points(
                self._mean_hand, self._anchors, -1, forest, self._rng(_POINTS, stage, 0)
            )
            rows = _RowChunks(self, frames, PALM_PART, forest.trees)
            votes: list[PalmVotes] = []

            def points(part: StageRows, votes: list[PalmVotes] = votes) -> list[wp.array]:
                if not votes:
                    votes.append(PalmVotes(
                        part, groups=part.pose.shape[0], modes=1, leaf_modes=forest.leaf_modes,
                        holistic=holistic,
                    ))  # fmt: skip
                votes[0].launch_points()
                return [part.frames, part.places, votes[0].points]

            values, (turns, places, now) = rows.values(poses, anchors[None], offsets[None], points)
            wanted = np.einsum(
                "nij,nki->nkj", turns[:, 0], self._truth[frames][:, order] - places[:, 0, None]
            )
            samples = Samples.of(
                wp.array(values[0], dtype=wp.int16, device=self._device),
                (wanted - now).astype(np.float32),
            )
            bags = self._bags(name, stage)
            trees = self._grow(name, stage, samples, bags[:, frames], 0, forest.leaf_modes)
            empty = ForestStage(
                anchors=anchors[None], offsets=offsets[None],
                **{f.name: getattr(trees[0], f.name) for f in fields(ForestStage)
                   if f.name not in ("anchors", "offsets")},
            )  # fmt: skip
            grown = join_trees(empty, trees)
            yield grown
            if stage + 1 < forest.stages:
                uploaded = DeviceStage.upload(grown, self._device)
                poses = rows.next_poses(poses, uploaded, bags, holistic)

    def _start_poses(self, per_frame: int) -> NDArray[np.float32]:
        """Some of the start poses of each frame, shape (nframe * per_frame, 28)."""
        rng = self._rng(_STARTS)
        found = np.empty((len(self.crops), NSTART, 28), np.float32)
        images = self.images(CHUNK_FRAMES)
        poses = wp.zeros((CHUNK_FRAMES, NSTART, 28), dtype=float, device=self._device)
        for first in range(0, len(self.crops), CHUNK_FRAMES):
            part = np.arange(first, min(first + CHUNK_FRAMES, len(self.crops)))
            self.load(images, part)
            launch_starts(self._hands, images, poses)
            found[part] = poses.numpy()[: len(part)]
        chosen = np.argsort(rng.random((len(self.crops), NSTART)), axis=1)[:, :per_frame]
        return np.take_along_axis(found, chosen[..., None], axis=1).reshape(-1, 28)

    # Fingers.

    def _train_fingers(self) -> Iterator[ForestStage]:
        """Cascades of the fingers, under a palm that is nearly right."""
        config, forest = self.config, self.config.forest
        frames = np.arange(len(self.crops))
        rng = self._rng(_SHAKE)
        shake = np.zeros((len(frames), 27))
        shake[:, :3] = rng.normal(0.0, config.palm_spread, (len(frames), 3))
        shake[:, 3:6] = rng.normal(0.0, config.palm_turn, (len(frames), 3))
        poses = apply_increment(self.crops.poses.astype(np.float64), shake)
        rest = np.stack([hand.rest_angles for hand in self.subjects])
        poses[:, 7:] = rest[self.crops.subjects]
        poses = poses.astype(np.float32)
        for stage in range(forest.stages):
            drawn = [
                draw_points(
                    self._mean_hand, self._anchors, finger, forest,
                    self._rng(_POINTS, stage, 1 + finger),
                )
                for finger in range(NFINGER)
            ]  # fmt: skip
            anchors = np.stack([one[0] for one in drawn])
            offsets = np.stack([one[1] for one in drawn])
            rows = _RowChunks(self, frames, FINGER_PARTS, NFINGER * forest.trees)

            def points(part: StageRows) -> list[wp.array]:
                moves = FingerMoves(part)
                moves.launch_points()
                return [part.frames, part.places, moves.points]

            values, (turns, places, now) = rows.values(poses, anchors, offsets, points)
            joints = self._truth[:, list(FINGER_KEYPOINTS)].reshape(-1, NFINGER, 3, 3)
            wanted = np.einsum("nfij,nfki->nfkj", turns, joints - places[:, :, None])
            bags = self._bags("fingers", stage)
            trees: list[ForestStage] = []
            for finger in range(NFINGER):
                samples = Samples.of(
                    wp.array(values[finger], dtype=wp.int16, device=self._device),
                    (wanted - now)[:, finger].astype(np.float32),
                )
                trees += self._grow(f"finger-{finger}", stage, samples, bags, finger, 1)
            empty = ForestStage(
                anchors=anchors, offsets=offsets,
                **{f.name: getattr(trees[0], f.name) for f in fields(ForestStage)
                   if f.name not in ("anchors", "offsets")},
            )  # fmt: skip
            grown = join_trees(empty, trees)
            yield grown
            if stage + 1 < forest.stages:
                uploaded = DeviceStage.upload(grown, self._device)
                poses = rows.next_finger_poses(poses, uploaded, np.tile(bags, (NFINGER, 1)))

    # Trees.

    def _grow(
        self, name: str, stage: int, samples: Samples, bags: NDArray[np.bool_], part: int,
        modes: int,
    ) -> list[ForestStage]:  # fmt: skip
        """Trees of one part and stage, those that are kept already among them."""

        def one(tree: int) -> ForestStage:
            path = self._work / f"tree-{self._fingerprint}-{name}-{stage}-{tree}.npz"
            found = _read_tree(path)
            if found is None:
                seed = int(self._rng(_TREE, stage, part, tree).integers(2**31))
                found = grow_tree(
                    samples, np.flatnonzero(bags[tree]), self.config.forest, part=part,
                    modes=modes, seed=seed,
                )  # fmt: skip
                with whole_file(path) as file:
                    np.savez(file, **{f.name: getattr(found, f.name) for f in fields(ForestStage)})
            return found

        trees = []
        with ThreadPoolExecutor(self._threads) as pool:
            for found in pool.map(one, range(self.config.forest.trees)):
                trees.append(found)
                self._done += 1
                self._report(self._done, f"{name}, stage {stage + 1}")
        return trees

    # Crops on the device.

    def images(self, count: int) -> ForestImages:
        """Arrays for so many crops."""
        return ForestImages.allocate(count, self.config.forest.crop_cells, self._device)

    def load(self, images: ForestImages, frames: NDArray[np.intp]) -> None:
        """Copy the crops of some frames to the device, in this order; the rest stays empty."""
        count, size = len(frames), images.cells.shape[0]
        stored = self.crops.cells[frames]
        cells = stored.astype(np.float32) * np.float32(DEPTH_UNIT)
        cells[stored == UNKNOWN] = np.inf

        def padded(values: NDArray) -> NDArray:
            full = np.zeros((size, *values.shape[1:]), values.dtype)
            full[:count] = values
            return full

        images.cells.assign(padded(cells))
        images.cameras.assign(padded(self.crops.cameras[frames]))
        images.gates.assign(padded(self._gates[frames]))
        images.image_hand.assign(padded(self.crops.subjects[frames].astype(np.int32)))


class _RowChunks:
    """Rows of all frames, walked through in chunks that fit on the device."""

    def __init__(
        self, trainer: ForestTrainer, frames: NDArray[np.intp], parts: NDArray, trees: int
    ) -> None:
        self._trainer, self._frames, self._parts = trainer, frames, parts
        self._per_frame = len(frames) // len(trainer.crops)
        self._trees = trees
        self._size = CHUNK_FRAMES * self._per_frame
        self._images = trainer.images(CHUNK_FRAMES)
        local = np.repeat(np.arange(CHUNK_FRAMES), self._per_frame)
        self.rows = StageRows(
            trainer._hands, self._images, trainer.config.forest, parts,
            row_hand=np.zeros(self._size), row_image=local, trees=trees,
        )  # fmt: skip

    def _chunks(self, poses: NDArray[np.float32]) -> Iterator[slice]:
        """Load one chunk of crops and poses after the other; yields its rows."""
        trainer = self._trainer
        for first in range(0, len(trainer.crops), CHUNK_FRAMES):
            frames = np.arange(first, min(first + CHUNK_FRAMES, len(trainer.crops)))
            trainer.load(self._images, frames)
            part = slice(first * self._per_frame, (frames[-1] + 1) * self._per_frame)
            count = part.stop - part.start
            full = np.zeros((self._size, 28), np.float32)
            full[:, 3] = 1.0
            full[:count] = poses[part]
            hands = np.zeros(self._size, np.int32)
            hands[:count] = trainer.crops.subjects[self._frames[part]]
            self.rows.pose.assign(full)
            self.rows.row_hand.assign(hands)
            yield part

    def values(
        self,
        poses: NDArray[np.float32],
        anchors: NDArray,
        offsets: NDArray,
        more: Callable[[StageRows], list[wp.array]],
    ) -> tuple[list[NDArray[np.int16]], list[NDArray[np.float32]]]:
        """Features of all rows, shape (npoint, nrow) per part, and further arrays of theirs."""
        device = self.rows.pose.device
        device_anchors = wp.array(anchors, dtype=int, device=device)
        device_offsets = wp.array(offsets, dtype=wp.vec3, device=device)
        count = len(self._frames)
        values = [np.empty((anchors.shape[1], count), np.int16) for _ in self._parts]
        gathered: list[list[NDArray]] = []
        for part in self._chunks(poses):
            self.rows.launch_values(device_anchors, device_offsets)
            arrays = more(self.rows)
            number = part.stop - part.start
            found = self.rows.values.numpy()[:number]
            for k, matrix in enumerate(values):
                matrix[:, part] = np.rint(found[:, k] / VALUE_STEP).T.astype(np.int16)
            gathered.append([array.numpy()[:number].copy() for array in arrays])
        return values, [np.concatenate(parts) for parts in zip(*gathered, strict=True)]

    def _leaves(
        self, poses: NDArray[np.float32], stage: DeviceStage, bags: NDArray[np.bool_]
    ) -> Iterator[slice]:
        """Walk all rows through a stage, each heard only by trees that did not learn from it."""
        for part in self._chunks(poses):
            frames = self._frames[part]
            weights = np.ones((self._size, self._trees), np.float32)
            unseen = ~bags[:, frames].T
            # Where all trees learnt from a frame, all may speak.
            weights[: len(frames)] = np.where(unseen.any(axis=1, keepdims=True), unseen, True)
            self.rows.tree_weights.assign(weights)
            self.rows.launch_values(stage.anchors, stage.offsets)
            self.rows.launch_leaves(stage)
            yield part

    def next_poses(
        self, poses: NDArray[np.float32], stage: DeviceStage, bags: NDArray[np.bool_],
        holistic: bool,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Poses after a stage of palm or hand: the strongest mode of each row."""
        rows, moved = self.rows, np.empty_like(poses)
        votes = PalmVotes(
            rows, groups=self._size, modes=1, leaf_modes=stage.updates.shape[1], holistic=holistic
        )
        fingers = None
        if holistic:
            own = StageRows(
                rows.hands, rows.images, rows.config, FINGER_PARTS,
                row_hand=np.zeros(self._size), row_image=rows.row_image.numpy(), trees=1,
                pose=rows.pose,
            )  # fmt: skip
            own.row_hand = rows.row_hand
            fingers = FingerMoves(own)
        for part in self._leaves(poses, stage, bags):
            votes.launch_points()
            votes.launch_modes(stage)
            votes.launch_poses(rows, fingers)
            moved[part] = rows.pose.numpy()[: part.stop - part.start]
        return moved

    def next_finger_poses(
        self, poses: NDArray[np.float32], stage: DeviceStage, bags: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Poses after a stage of the fingers: the medians of each row."""
        moves, moved = FingerMoves(self.rows), np.empty_like(poses)
        for part in self._leaves(poses, stage, bags):
            moves.launch_points()
            moves.launch_medians(stage)
            moves.launch_bend()
            moved[part] = self.rows.pose.numpy()[: part.stop - part.start]
        return moved


def _read_tree(path: Path) -> ForestStage | None:
    """A tree that was kept, None without one."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            return ForestStage(**{f.name: data[f.name] for f in fields(ForestStage)})
    except UNREADABLE:
        return None
