"""Forests on a device: the arrays of a stage, and the rows that walk through it.

Training and tracking launch the same kernels through `StageRows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.forest.artifact import MIDDLE_POINT, PALM_KEYPOINTS, ForestStage
from handtrack.forest.config import ForestConfig
from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import BASE_BONES, FINGERS, NANGLE, NBONE
from handtrack.kernels import finger_ik, forest_features, forest_votes, kinematics, skinning
from handtrack.transforms import matrix_to_quat

NFINGER = len(FINGERS)

PALM_PART = np.zeros(1, np.int32)
"""Reference bone of the one part of palm and holistic forests."""

FINGER_PARTS = np.array(BASE_BONES, np.int32)
"""Reference bones of the five parts of finger forests."""

IK_STEPS, IK_DAMPING = 6, 1e-4
"""Gauss-Newton steps per finger, and what is added to their diagonal [m^2/rad^2]."""

START_STRIDE = 2
"""Every so many cells in both directions tell the start poses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForestHands:
    """Right hands as forests need them."""

    arrays: DeviceHand
    """Kinematics, and skin of the anchor vertices."""
    palm_points: wp.array
    """Palm points in the palm's frame [m], shape (nhand, npalm) vec3."""
    angles: wp.array
    """Joint angles of start poses [rad], shape (nhand, 21)."""

    @classmethod
    def upload(
        cls, hands: Sequence[ShapedHand], anchor_vertices: NDArray, device: wp.Device
    ) -> ForestHands:
        """Copy right hands to a device."""
        points = _palm_points(hands)
        angles = np.stack([hand.rest_angles for hand in hands])
        return cls(
            arrays=DeviceHand.upload(hands, device, vertices=anchor_vertices),
            palm_points=wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
            angles=wp.array(angles.astype(np.float32), dtype=float, device=device),
        )

    def resize(self, hands: Sequence[ShapedHand]) -> None:
        """Overwrite the lengths, in place, with those of hands that differ in scale alone."""
        self.arrays.resize(hands)
        self.palm_points.assign(_palm_points(hands).astype(np.float32))

    @property
    def count(self) -> int:
        """Palm points per hand."""
        return self.palm_points.shape[1]


def _palm_points(hands: Sequence[ShapedHand]) -> NDArray[np.float64]:
    """Palm points of each hand in the palm's frame [m], shape (nhand, npalm, 3)."""
    rest = np.zeros(28)
    rest[3] = 1.0
    return np.stack([keypoints(hand, rest)[list(PALM_KEYPOINTS)] for hand in hands])


@dataclass(slots=True, kw_only=True)
class ForestImages:
    """Crops that rows look at; `gates` and poses are in the mirrored frame for left hands."""

    cells: wp.array
    cameras: wp.array
    gates: wp.array
    image_hand: wp.array
    mirror: float

    @classmethod
    def allocate(cls, count: int, cells: int, device: wp.Device) -> ForestImages:
        """Allocate crops of right hands."""
        return cls(
            cells=wp.zeros((count, cells, cells), dtype=float, device=device),
            cameras=wp.zeros((count, 4), dtype=float, device=device),
            gates=wp.zeros((count, 4), dtype=float, device=device),
            image_hand=wp.zeros(count, dtype=int, device=device),
            mirror=1.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceStage:
    """The trees of one stage on a device; arrays named as the kernels name them."""

    anchors: wp.array
    offsets: wp.array
    tree_parts: wp.array
    roots: wp.array
    node_points: wp.array
    thresholds: wp.array
    children: wp.array
    updates: wp.array
    leaf_weights: wp.array

    @classmethod
    def upload(cls, stage: ForestStage, device: wp.Device) -> DeviceStage:
        """Copy a stage to a device."""
        vectors = {"offsets", "updates"}

        def put(name: str) -> wp.array:
            values = np.ascontiguousarray(getattr(stage, name))
            if name in vectors:
                return wp.array(values.astype(np.float32), dtype=wp.vec3, device=device)
            kind = float if np.issubdtype(values.dtype, np.floating) else int
            return wp.array(values, dtype=kind, device=device)

        return cls(**{name: put(name) for name in cls.__slots__})

    @property
    def tree_count(self) -> int:
        """Trees of all parts."""
        return self.roots.shape[0]


class StageRows:
    """Rows (hypotheses) in front of a stage: reference frames, features, leaves."""

    def __init__(
        self,
        hands: ForestHands,
        images: ForestImages,
        config: ForestConfig,
        part_bones: NDArray[np.int32],
        *,
        row_hand: ArrayLike,
        row_image: ArrayLike,
        trees: int,
        pose: wp.array | None = None,
    ) -> None:
        """Allocate.

        Args:
            hands: The hands.
            images: The crops.
            config: Settings of the forest.
            part_bones: `PALM_PART` or `FINGER_PARTS`.
            row_hand: Hand of each row, shape (nrow,).
            row_image: Image of each row, shape (nrow,).
            trees: Trees of all parts.
            pose: Poses to work on, shape (nrow, 28); allocated when None.
        """
        device = images.cells.device
        nrow, npart = len(np.asarray(row_hand)), len(part_bones)
        self.hands, self.images, self.config = hands, images, config
        self.part_bones = wp.array(part_bones, dtype=int, device=device)
        self.row_hand = wp.array(np.asarray(row_hand, np.int32), dtype=int, device=device)
        self.row_image = wp.array(np.asarray(row_image, np.int32), dtype=int, device=device)

        def make(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        nanchor = hands.arrays.weights.shape[0]
        self.pose = make(nrow, 28) if pose is None else pose
        self.rotations = make(nrow, NBONE, dtype=wp.mat33)
        self.origins = make(nrow, NBONE, dtype=wp.vec3)
        self.axes = make(nrow, NANGLE, dtype=wp.vec3)
        self.vertices = make(nrow, nanchor, dtype=wp.vec3)
        self.normals = make(nrow, nanchor, dtype=wp.vec3)
        self.frames = make(nrow, npart, dtype=wp.mat33)
        self.places = make(nrow, npart, dtype=wp.vec3)
        self.centres = make(nrow, dtype=wp.vec3)
        self.values = make(nrow, npart, config.points)
        self.leaves = make(nrow, trees, dtype=int)
        self.tree_weights = wp.ones((nrow, trees), dtype=float, device=device)

    def launch_values(self, anchors: wp.array, offsets: wp.array) -> None:
        """Reference frames and depths at the reference points, of the poses as they are."""
        hand, images = self.hands.arrays, self.images
        kinematics.pose_bones(
            hand.bone_rotations, hand.bone_origins, hand.bone_parents, hand.bone_angles,
            hand.angle_axes, self.row_hand, self.pose,
            rotations=self.rotations, origins=self.origins, axes=self.axes,
        )  # fmt: skip
        skinning.skin_vertices(
            hand.weight_bones, hand.weights, hand.local_vertices, hand.local_normals,
            self.row_hand, self.rotations, self.origins,
            vertices=self.vertices, normals=self.normals,
        )  # fmt: skip
        self.launch_frames()
        forest_features.sample_points(
            anchors, offsets, self.row_image, images.cells, images.cameras, self.centres,
            self.frames, self.places, self.vertices, mirror=images.mirror,
            gate_radius=self.config.gate_radius, depth_range=self.config.depth_range,
            values=self.values,
        )  # fmt: skip

    def launch_frames(self) -> None:
        """Reference frames of the poses as they are."""
        hand = self.hands.arrays
        forest_features.frame_parts(
            hand.bone_rotations, hand.bone_origins, self.part_bones, self.hands.palm_points,
            self.row_hand, self.pose, middle_point=MIDDLE_POINT,
            frames=self.frames, places=self.places, centres=self.centres,
        )  # fmt: skip

    def launch_leaves(self, stage: DeviceStage) -> None:
        """Leaves that the features lead to."""
        forest_features.traverse_trees(
            stage.tree_parts, stage.roots, stage.node_points, stage.thresholds, stage.children,
            self.values, leaves=self.leaves,
        )  # fmt: skip


class FingerMoves:
    """Outer joints of all fingers of some rows, and where a forest wants them."""

    def __init__(self, rows: StageRows) -> None:
        """Allocate for the rows of a finger stage."""
        shape = (rows.pose.shape[0], NFINGER, 3)
        device = rows.pose.device
        self.rows = rows
        self.points = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.targets = wp.zeros(shape, dtype=wp.vec3, device=device)

    def launch_points(self) -> None:
        """Where the joints are."""
        hand = self.rows.hands.arrays
        finger_ik.place_fingers(
            hand.bone_rotations, hand.bone_origins, hand.tip_offsets, hand.angle_axes,
            hand.bone_angles, self.rows.row_hand, self.rows.pose, points=self.points,
        )  # fmt: skip

    def launch_medians(self, stage: DeviceStage) -> None:
        """Where the medians of the trees put them (II.4.3)."""
        forest_votes.median_votes(
            stage.updates, self.rows.leaves, self.rows.tree_weights, self.points,
            trees=stage.tree_count // NFINGER, targets=self.targets,
        )  # fmt: skip

    def launch_bend(self) -> None:
        """Bend the fingers there."""
        hand = self.rows.hands.arrays
        finger_ik.bend_fingers(
            hand.bone_rotations, hand.bone_origins, hand.tip_offsets, hand.angle_axes,
            hand.bone_angles, hand.limits, self.rows.row_hand, self.targets,
            iterations=IK_STEPS, damping=IK_DAMPING, pose=self.rows.pose,
        )  # fmt: skip


class PalmVotes:
    """Votes of rows for the palm (or for all joints of the hand), in groups, and their modes."""

    def __init__(
        self, rows: StageRows, *, groups: int, modes: int, leaf_modes: int, holistic: bool
    ) -> None:
        """Allocate.

        Args:
            rows: The voting rows, the same number in each group, groups one after the other.
            groups: Groups of rows.
            modes: Modes kept per group.
            leaf_modes: Modes per leaf.
            holistic: Vote for the fingers' joints too.
        """
        device = rows.pose.device
        nrow, trees = rows.leaves.shape
        per_group = nrow // groups
        nvote, npoint = per_group * trees * leaf_modes, rows.hands.count + 15 * holistic

        def make(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.rows = rows
        self.row_group = wp.array(np.arange(nrow) // per_group, dtype=int, device=device)
        self.row_slot = wp.array(np.arange(nrow) % per_group, dtype=int, device=device)
        self.finger_points = make(nrow, NFINGER, 3, dtype=wp.vec3)
        self.points = make(nrow, npoint, dtype=wp.vec3)
        self.votes = make(groups, nvote, npoint, dtype=wp.vec3)
        self.weights = make(groups, nvote)
        self.densities = make(groups, nvote)
        self.modes = make(groups, modes, npoint, dtype=wp.vec3)
        self.mode_weights = make(groups, modes)
        self._holistic = holistic

    def launch_points(self) -> None:
        """Where the voted points are now, palm frame."""
        hand, rows = self.rows.hands.arrays, self.rows
        if self._holistic:
            finger_ik.place_fingers(
                hand.bone_rotations, hand.bone_origins, hand.tip_offsets, hand.angle_axes,
                hand.bone_angles, rows.row_hand, rows.pose, points=self.finger_points,
            )  # fmt: skip
        forest_votes.join_points(
            hand.bone_rotations, hand.bone_origins, rows.hands.palm_points, rows.row_hand,
            self.finger_points, points=self.points,
        )  # fmt: skip

    def launch_modes(self, stage: DeviceStage) -> None:
        """Vote, and pick the modes of each group."""
        rows = self.rows
        forest_votes.cast_votes(
            stage.updates, stage.leaf_weights, self.row_group, self.row_slot, self.points,
            rows.frames, rows.places, rows.leaves, rows.tree_weights,
            votes=self.votes, weights=self.weights,
        )  # fmt: skip
        forest_votes.pick_modes(
            self.votes, self.weights, radius=rows.config.mode_radius,
            densities=self.densities, modes=self.modes, mode_weights=self.mode_weights,
        )  # fmt: skip

    def launch_poses(self, target: StageRows, fingers: FingerMoves | None = None) -> None:
        """Lay the palms of rows, one per mode of each group, on the modes.

        Args:
            target: The rows whose poses are set.
            fingers: With holistic votes, finger rows that share those poses.
        """
        hands = target.hands
        forest_votes.lay_palms(
            hands.palm_points, hands.angles, target.row_hand, self.modes, pose=target.pose
        )
        if fingers is not None:
            rows = fingers.rows
            rows.launch_frames()
            forest_votes.aim_fingers(self.modes, rows.frames, rows.places, targets=fingers.targets)
            fingers.launch_bend()


def region_poses(
    centres: ArrayLike, wrists: ArrayLike, hands: ForestHands, worn: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Poses that a region suggests: from its wrist to its middle, seen from the camera.

    Args:
        centres: Middle of each region [m], shape (n, 3).
        wrists: Where it joins an arm [m], NaN where it stands alone, shape (n, 3); it is then taken
            to point up.
        hands: The hands whose middle knuckles are put into the middles.
        worn: Number of each region's hand, shape (n,).

    Returns:
        Poses, shape (n, 28).
    """
    centres, wrists = np.asarray(centres, np.float64), np.asarray(wrists, np.float64)
    along = np.where(np.isfinite(wrists), centres - wrists, [0.0, -1.0, 0.0])
    ray = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    # Across the ray as far as it goes; a region straight ahead of its wrist points up.
    along = along - (along * ray).sum(axis=1, keepdims=True) * ray
    up = np.array([0.0, -1.0, 0.0]) - (-ray[:, 1:2]) * ray
    along = np.where(np.linalg.norm(along, axis=1, keepdims=True) > 0.01, along, up)
    x = along / np.linalg.norm(along, axis=1, keepdims=True)
    rotation = np.stack([x, ray, np.cross(x, ray)], axis=2)
    middle = hands.palm_points.numpy()[worn, MIDDLE_POINT].astype(np.float64)
    poses = np.zeros((len(centres), 28))
    poses[:, :3] = centres - (rotation @ middle[..., None])[..., 0]
    poses[:, 3:7] = matrix_to_quat(rotation)
    poses[:, 7:] = hands.angles.numpy()[worn]
    return poses


def launch_starts(hands: ForestHands, images: ForestImages, poses: wp.array) -> None:
    """Start poses of every image, shape (nimage, NSTART, 28) (II.4.2)."""
    forest_features.principal_starts(
        hands.palm_points, hands.angles, images.image_hand, images.cells, images.cameras,
        images.gates, middle_point=MIDDLE_POINT, mirror=images.mirror, stride=START_STRIDE,
        poses=poses,
    )  # fmt: skip
