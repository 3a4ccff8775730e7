"""Run trained forests on depth images: several palms per image, then fingers on each (II.4.2).

Palms and fingers are apart, since tracking refines the palms in between (II.5.1, step 1).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.device import FrameGraph, resolve_device
from handtrack.errors import InputError
from handtrack.forest.artifact import Forest
from handtrack.forest.crops import Cropper
from handtrack.forest.rows import (
    FINGER_PARTS,
    PALM_PART,
    DeviceStage,
    FingerMoves,
    ForestHands,
    ForestImages,
    PalmVotes,
    StageRows,
    launch_starts,
    region_poses,
)
from handtrack.hand.model import ShapedHand
from handtrack.hand.side import mirror_pose
from handtrack.kernels.forest_features import NSTART

_MIRROR = np.array([-1.0, 1.0, 1.0])


class Cascade:
    """A forest with everything it needs to look at a fixed number of images of one camera."""

    def __init__(
        self,
        forest: Forest,
        hands: Sequence[ShapedHand],
        camera: Camera,
        *,
        side: str = "right",
        device: str | None = None,
        graph: bool = True,
    ) -> None:
        """Allocate.

        Args:
            forest: The trained forest.
            hands: Right hand of the person in each image; forests look at left hands in a mirror.
            camera: Camera of the images.
            side: Which hand is in the images.
            device: "cpu", "cuda:N" or None for the best there is.
            graph: False launches eagerly, for debugging.

        Raises:
            InputError: A hand is not a right one.
        """
        if any(hand.side != "right" for hand in hands):
            raise InputError("a Cascade takes right hands; pass side='left' for left ones")
        self.device = resolve_device(device)
        config = forest.config
        self.image_count, self.mode_count = len(hands), config.modes
        self._left = side == "left"
        self._gate_radius = config.gate_radius
        self._cropper = Cropper(camera, config, len(hands), device=self.device)
        self._images = ForestImages(
            cells=self._cropper.cells, cameras=self._cropper.crops,
            gates=wp.zeros((len(hands), 4), dtype=float, device=self.device),
            image_hand=wp.array(np.arange(len(hands)), dtype=int, device=self.device),
            mirror=-1.0 if self._left else 1.0,
        )  # fmt: skip
        uploaded = ForestHands.upload(hands, forest.anchor_vertices, self.device)
        self._hands = uploaded
        self._palm = [DeviceStage.upload(stage, self.device) for stage in forest.palm]
        self._fingers = [DeviceStage.upload(stage, self.device) for stage in forest.fingers]
        self._presence: DeviceStage | None = None

        def rows(per_image: int, parts: NDArray, trees: int, pose: wp.array | None = None):
            image = np.repeat(np.arange(len(hands)), per_image)
            return StageRows(
                uploaded, self._images, config, parts, row_hand=image, row_image=image,
                trees=trees, pose=pose,
            )  # fmt: skip

        if forest.presence is not None:
            self._presence = DeviceStage.upload(forest.presence, self.device)
            self._chances = forest.presence.updates[:, 0, 0, 0]
            self._regions = rows(1, PALM_PART, self._presence.tree_count)
        trees = self._palm[0].tree_count
        self._starts = rows(NSTART, PALM_PART, trees)
        self._start_poses = self._starts.pose.reshape((len(hands), NSTART, 28))
        self._palms = rows(config.modes, PALM_PART, trees)
        leaf_modes = self._palm[0].updates.shape[1]
        self._first, self._later = (
            PalmVotes(
                one, groups=len(hands), modes=config.modes, leaf_modes=leaf_modes,
                holistic=forest.holistic,
            )
            for one in (self._starts, self._palms)
        )  # fmt: skip
        finger_trees = self._fingers[0].tree_count if self._fingers else 1
        own = rows(config.modes, FINGER_PARTS, finger_trees, self._palms.pose)
        self._moves = FingerMoves(own)
        self._holistic = forest.holistic
        self._palm_graph = FrameGraph(self._launch_palms, self.device, graph=graph)
        self._finger_graph = FrameGraph(self._launch_fingers, self.device, graph=graph)

    def resize(self, hands: Sequence[ShapedHand]) -> None:
        """Go on with the same right hands at other scales, one per image."""
        self._hands.resize(hands)

    def load(
        self, depth: NDArray[np.float32], centres: ArrayLike, wrists: ArrayLike | None = None
    ) -> None:
        """Copy images to the device and lay a crop around each expected hand.

        Args:
            depth: Depth [m], shape (nimage, height, width), or (height, width) for all images.
            centres: About the middle of what is seen of each hand [m], shape (nimage, 3).
            wrists: Where it joins an arm [m], NaN where it does not, same shape; for `presence`.
        """
        centres = np.asarray(centres, np.float64).reshape(self.image_count, 3)
        self._cropper.depth.assign(np.broadcast_to(depth, self._cropper.depth.shape))
        self._cropper.place(centres)
        ends = np.full_like(centres, np.nan) if wrists is None else np.asarray(wrists, np.float64)
        if self._left:
            centres, ends = centres * _MIRROR, ends * _MIRROR
        gates = np.column_stack([centres, np.full(len(centres), self._gate_radius)])
        self._images.gates.assign(gates.astype(np.float32))
        if self._presence is not None:
            poses = region_poses(centres, ends, self._hands, np.arange(len(centres)))
            self._regions.pose.assign(poses.astype(np.float32))

    def run_palms(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Palms in the loaded images.

        Returns:
            Poses at start angles (holistic: with the voted fingers), shape (nimage, nmode, 28),
            and the weights of their votes, the heaviest first, 0 for none, shape (nimage, nmode).
        """
        self._palm_graph()
        wp.synchronize_device(self.device)
        weights = self._later.mode_weights if len(self._palm) > 1 else self._first.mode_weights
        return self._poses(), np.array(weights.numpy(), np.float32)

    def presence(self) -> NDArray[np.float64]:
        """Chance that a hand is in each place that `run_palms` looked at, shape (nimage,).

        1 where the forest has not learnt what is no hand.
        """
        if self._presence is None:
            return np.ones(self.image_count)
        leaves = np.array(self._regions.leaves.numpy(), np.int64)
        return self._chances[leaves].mean(axis=1, dtype=np.float64)

    def run_fingers(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Bend the fingers under given palms.

        Args:
            poses: Poses, shape (nimage, nmode, 28); their angles are where the cascade starts. They
                are bent in the crops that `run_palms` has cut.

        Returns:
            Poses, same shape. Holistic forests return them as they came.
        """
        poses = np.asarray(poses, np.float64).reshape(self.image_count, self.mode_count, 28)
        if self._holistic:
            return poses
        flat = poses.reshape(-1, 28)
        self._palms.pose.assign((mirror_pose(flat) if self._left else flat).astype(np.float32))
        self._finger_graph()
        wp.synchronize_device(self.device)
        return self._poses()

    def _poses(self) -> NDArray[np.float64]:
        """Poses of all rows in the camera's frame."""
        poses = self._palms.pose.numpy().astype(np.float64)
        poses[:, 3:7] /= np.maximum(np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True), 1e-9)
        poses = mirror_pose(poses) if self._left else poses
        return poses.reshape(self.image_count, self.mode_count, 28)

    def _launch_palms(self) -> None:
        self._cropper.launch()
        launch_starts(self._hands, self._images, self._start_poses)
        for number, stage in enumerate(self._palm):
            rows, votes = (self._starts, self._first) if number == 0 else (self._palms, self._later)
            rows.launch_values(stage.anchors, stage.offsets)
            rows.launch_leaves(stage)
            votes.launch_points()
            votes.launch_modes(stage)
            votes.launch_poses(self._palms, self._moves if self._holistic else None)
        if self._presence is not None:
            self._regions.launch_values(self._presence.anchors, self._presence.offsets)
            self._regions.launch_leaves(self._presence)

    def _launch_fingers(self) -> None:
        for stage in self._fingers:
            self._moves.rows.launch_values(stage.anchors, stage.offsets)
            self._moves.rows.launch_leaves(stage)
            self._moves.launch_points()
            self._moves.launch_medians(stage)
            self._moves.launch_bend()
