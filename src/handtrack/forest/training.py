"""Training the cascades, stage by stage, going on where an earlier run stopped (thesis II.4)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields, replace
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
from handtrack.forest.config import ForestConfig, TrainingConfig
from handtrack.forest.crops import TrainingCrops
from handtrack.forest.growing import Samples, grow_tree
from handtrack.forest.reference_points import draw_points, spread_vertices
from handtrack.forest.row_chunks import CropSource, RowChunks
from handtrack.forest.rows import (
    FINGER_PARTS,
    NFINGER,
    PALM_PART,
    DeviceStage,
    FingerMoves,
    ForestHands,
    PalmVotes,
    StageRows,
    region_poses,
)
from handtrack.forest.scenes import RegionCrops
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.skeleton import NKEYPOINT
from handtrack.kernels.forest_features import NSTART
from handtrack.transforms import apply_increment, quat_to_matrix

_BAG, _POINTS, _GATES, _STARTS, _SHAKE, _TREE, _MEAN = 1, 2, 3, 4, 5, 6, 7
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
        regions: RegionCrops | None = None,
        device: str | None = None,
        threads: int = 1,
    ) -> None:
        """Prepare.

        Args:
            config: What to learn.
            crops: Labelled crops.
            subjects: Right hands that `crops.subjects` counts.
            regions: Right and wrong regions, from which the forest learns what is a hand; None
                leaves that out.
            work: Folder of unfinished work; trees in it that belong to `config` are used again.
            device: "cpu", "cuda:N" or None for the best there is.
            threads: Trees grown at a time.
        """
        self.config, self.crops, self.subjects = config, crops, subjects
        self._regions = regions
        self._work, self._threads = work, threads
        self._device = resolve_device(device)
        model = HandModel.load()
        self._mean_hand = model.shaped()
        self._anchors = spread_vertices(self._mean_hand)
        self._worn_hands = [*subjects, self._mean_hand]
        self._hands = ForestHands.upload(self._worn_hands, self._anchors, self._device)
        self._fingerprint = hashlib.sha256(
            json.dumps(asdict(config), sort_keys=True).encode()
            + np.ascontiguousarray(crops.poses).tobytes()
        ).hexdigest()[:16]
        self._truth = np.empty((len(crops), NKEYPOINT, 3), np.float32)
        for subject, hand in enumerate(subjects):
            mine = crops.subjects == subject
            self._truth[mine] = keypoints(hand, crops.poses[mine])
        as_mean = self._rng(_MEAN).random(len(crops)) < config.mean_share
        self._source = CropSource(
            cells=crops.cells, cameras=crops.cameras, gates=self._draw_gates(),
            worn=np.where(as_mean, len(subjects), crops.subjects).astype(np.int32),
            hands=self._hands,
        )  # fmt: skip
        forest = config.forest
        finger_trees = 0 if forest.structure == "holistic" else NFINGER * forest.trees
        self.tree_count = forest.stages * (forest.trees + finger_trees)
        self.tree_count += forest.presence_trees * (regions is not None)
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
        presence = None if self._regions is None else self._train_presence()
        return Forest(
            config=forest, anchor_vertices=self._anchors, palm=palm, fingers=fingers,
            presence=presence,
        )  # fmt: skip

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
        poses = self._source.start_poses(per_frame, self._rng(_STARTS))
        for stage in range(forest.stages):
            anchors, offsets = draw_points(
                self._mean_hand, self._anchors, -1, forest, self._rng(_POINTS, stage, 0)
            )
            rows = RowChunks(
                self._source, forest, per_frame=per_frame, parts=PALM_PART, trees=forest.trees
            )
            votes = PalmVotes(
                rows.rows, groups=rows.rows.pose.shape[0], modes=1, leaf_modes=forest.leaf_modes,
                holistic=holistic,
            )  # fmt: skip

            def points(part: StageRows, votes: PalmVotes = votes) -> list[wp.array]:
                votes.launch_points()
                return [part.frames, part.places, votes.points]

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
            empty = replace(trees[0], anchors=anchors[None], offsets=offsets[None])
            grown = join_trees(empty, trees)
            yield grown
            if stage + 1 < forest.stages:
                uploaded = DeviceStage.upload(grown, self._device)
                poses = rows.next_poses(poses, uploaded, bags, holistic)

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
        rest = np.stack([hand.rest_angles for hand in self._worn_hands])
        poses[:, 7:] = rest[self._source.worn]
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
            rows = RowChunks(
                self._source, forest, per_frame=1, parts=FINGER_PARTS,
                trees=NFINGER * forest.trees,
            )  # fmt: skip

            finger_moves = FingerMoves(rows.rows)

            def points(part: StageRows, moves: FingerMoves = finger_moves) -> list[wp.array]:
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
            empty = replace(trees[0], anchors=anchors, offsets=offsets)
            grown = join_trees(empty, trees)
            yield grown
            if stage + 1 < forest.stages:
                uploaded = DeviceStage.upload(grown, self._device)
                poses = rows.next_finger_poses(poses, uploaded, np.tile(bags, (NFINGER, 1)))

    # Hand or not.

    def _train_presence(self) -> ForestStage:
        """Trees that tell hands from elbows, heads and cups, in frames that the arm points out."""
        forest, regions = self.config.forest, self._regions
        assert regions is not None
        # Nothing is known of the hand yet that points could hang on.
        plain = replace(forest, features="pose-indexed")
        anchors, offsets = draw_points(
            self._mean_hand, self._anchors, -1, plain, self._rng(_POINTS, 99, 0)
        )
        gates = np.column_stack([regions.centres, np.full(len(regions), forest.gate_radius)])
        mean = len(self._worn_hands) - 1
        source = CropSource(
            cells=regions.cells, cameras=regions.cameras, gates=gates.astype(np.float32),
            worn=np.full(len(regions), mean, np.int32), hands=self._hands,
        )  # fmt: skip
        poses = region_poses(regions.centres, regions.wrists, self._hands, source.worn)
        rows = RowChunks(source, forest, per_frame=1, parts=PALM_PART, trees=forest.trees)
        values, _ = rows.values(
            poses.astype(np.float32), anchors[None], offsets[None], lambda part: [part.places]
        )
        targets = np.zeros((len(regions), 1, 3), np.float32)
        targets[:, 0, 0] = regions.is_hand
        samples = Samples.of(wp.array(values[0], dtype=wp.int16, device=self._device), targets)
        # By scene: what a tree has seen of one is not asked of it again.
        draw = self._rng(_BAG, 99).random((forest.presence_trees, int(regions.frames.max()) + 1))
        bags = (draw < forest.bag)[:, regions.frames]
        grown = replace(forest, candidates=forest.presence_candidates)
        trees = self._grow("presence", 0, samples, bags, 0, 1, grown)
        return join_trees(replace(trees[0], anchors=anchors[None], offsets=offsets[None]), trees)

    # Trees.

    def _grow(
        self, name: str, stage: int, samples: Samples, bags: NDArray[np.bool_], part: int,
        modes: int, config: ForestConfig | None = None,
    ) -> list[ForestStage]:  # fmt: skip
        """Trees of one part and stage, one per bag, those that are kept already among them."""

        def one(tree: int) -> ForestStage:
            path = self._work / f"tree-{self._fingerprint}-{name}-{stage}-{tree}.npz"
            found = _read_tree(path)
            if found is None:
                seed = int(self._rng(_TREE, stage, part, tree).integers(2**31))
                found = grow_tree(
                    samples, np.flatnonzero(bags[tree]), config or self.config.forest, part=part,
                    modes=modes, seed=seed,
                )  # fmt: skip
                with whole_file(path) as file:
                    np.savez(file, **{f.name: getattr(found, f.name) for f in fields(ForestStage)})
            return found

        trees = []
        with ThreadPoolExecutor(self._threads) as pool:
            for found in pool.map(one, range(len(bags))):
                trees.append(found)
                self._done += 1
                self._report(self._done, f"{name}, stage {stage + 1}")
        return trees


def _read_tree(path: Path) -> ForestStage | None:
    """A tree that was kept, None without one."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            return ForestStage(**{f.name: data[f.name] for f in fields(ForestStage)})
    except UNREADABLE:
        return None
