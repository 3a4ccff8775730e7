"""All rows of a training set, walked through in chunks that fit on a device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.forest.config import ForestConfig
from handtrack.forest.crops import DEPTH_UNIT, UNKNOWN
from handtrack.forest.growing import VALUE_STEP
from handtrack.forest.rows import (
    FINGER_PARTS,
    DeviceStage,
    FingerMoves,
    ForestHands,
    ForestImages,
    PalmVotes,
    StageRows,
    launch_starts,
)
from handtrack.kernels.forest_features import NSTART

CHUNK_FRAMES = 512
"""Frames whose rows are on the device at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CropSource:
    """Crops, where hands are expected in them, and the hands that they are looked at with."""

    cells: NDArray[np.uint16]
    """Stored crops, shape (n, cells, cells)."""
    cameras: NDArray[np.float32]
    """fx, fy, cx, cy of their grids [cells], shape (n, 4)."""
    gates: NDArray[np.float32]
    """Ball that holds the hand [m], shape (n, 4)."""
    worn: NDArray[np.int32]
    """Number of each crop's hand, shape (n,)."""
    hands: ForestHands
    """The hands."""

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def device(self) -> Any:
        """Where the hands are."""
        return self.hands.palm_points.device

    def images(self) -> ForestImages:
        """Arrays for one chunk."""
        return ForestImages.allocate(CHUNK_FRAMES, self.cells.shape[1], self.device)

    def load(self, images: ForestImages, frames: NDArray[np.intp]) -> None:
        """Copy the crops of some frames to the device, in this order; the rest stays empty."""
        count, size = len(frames), images.cells.shape[0]
        stored = self.cells[frames]
        cells = stored.astype(np.float32) * np.float32(DEPTH_UNIT)
        cells[stored == UNKNOWN] = np.inf

        def padded(values: NDArray) -> NDArray:
            full = np.zeros((size, *values.shape[1:]), values.dtype)
            full[:count] = values
            return full

        images.cells.assign(padded(cells))
        images.cameras.assign(padded(self.cameras[frames]))
        images.gates.assign(padded(self.gates[frames]))
        images.image_hand.assign(padded(self.worn[frames]))

    def start_poses(self, per_frame: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Some of the start poses of each frame (II.4.2), shape (nframe * per_frame, 28)."""
        found = np.empty((len(self), NSTART, 28), np.float32)
        images = self.images()
        poses = wp.zeros((CHUNK_FRAMES, NSTART, 28), dtype=float, device=self.device)
        for first in range(0, len(self), CHUNK_FRAMES):
            part = np.arange(first, min(first + CHUNK_FRAMES, len(self)))
            self.load(images, part)
            launch_starts(self.hands, images, poses)
            found[part] = poses.numpy()[: len(part)]
        chosen = np.argsort(rng.random((len(self), NSTART)), axis=1)[:, :per_frame]
        return np.take_along_axis(found, chosen[..., None], axis=1).reshape(-1, 28)


class RowChunks:
    """Rows of all frames, walked through in chunks that fit on the device."""

    def __init__(
        self, source: CropSource, config: ForestConfig, *, per_frame: int, parts: NDArray,
        trees: int,
    ) -> None:  # fmt: skip
        """Allocate one chunk.

        Args:
            source: The crops.
            config: Settings of the forest.
            per_frame: Rows per frame.
            parts: `PALM_PART` or `FINGER_PARTS`.
            trees: Trees of all parts.
        """
        self._source, self._parts, self._trees = source, parts, trees
        self._per_frame = per_frame
        self._frames = np.repeat(np.arange(len(source)), per_frame)
        self._size = CHUNK_FRAMES * per_frame
        self._images = source.images()
        local = np.repeat(np.arange(CHUNK_FRAMES), per_frame)
        self.rows = StageRows(
            source.hands, self._images, config, parts,
            row_hand=np.zeros(self._size), row_image=local, trees=trees,
        )  # fmt: skip

    def _chunks(self, poses: NDArray[np.float32]) -> Iterator[slice]:
        """Load one chunk of crops and poses after the other; yields its rows."""
        source = self._source
        for first in range(0, len(source), CHUNK_FRAMES):
            frames = np.arange(first, min(first + CHUNK_FRAMES, len(source)))
            source.load(self._images, frames)
            part = slice(first * self._per_frame, (frames[-1] + 1) * self._per_frame)
            count = part.stop - part.start
            full = np.zeros((self._size, 28), np.float32)
            full[:, 3] = 1.0
            full[:count] = poses[part]
            hands = np.zeros(self._size, np.int32)
            hands[:count] = source.worn[self._frames[part]]
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
