"""What a good closing motion is: the objective of Eq. III.4, for motions of all grip modes at once.

The thesis gives weights but no units: lengths count here in millimetres (in centimetres in the
control term), angles in radians. Four things go beyond it: the table counts like the object; the
collision penalty also grows with the depth, so that a swarm feels which way is out; contacts must
press with the side of the skin that the grip mode presses with; and all contacts together should
balance without friction, since pairs of them that oppose each other do not say so for more than two
(distance of the origin from the hull of the contacts' wrenches, after Ferrari and Canny 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.grip_device import GripDevice
from handtrack.grasp.score_batch import ScoreBatch
from handtrack.grasp.swarm import SwarmConfig
from handtrack.hand.kinematics import keypoints
from handtrack.kernels.grasp_motion import Placing
from handtrack.kernels.grasp_score import GraspTask
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import matrix_to_quat

Float = NDArray[np.float64]

TERMS: tuple[str, ...] = ("prior", "control", "collision", "contact", "quality")
"""Terms of Eq. III.4 in its order."""

NO_TABLE = (0.0, 0.0, 1.0, -1e3)
"""A table so far below that nothing reaches it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectiveConfig:
    """Weights of Eq. III.4 and III.9; 0 leaves a term out."""

    prior: float = 0.06
    """w_p: -ln pr of the motion's coordinates."""
    control: float = 0.9
    """w_c: distance from what the user asked for [1/cm]."""
    collision: float = 1.0
    """w_k: share of frames in collision, times `penalty`, and depth."""
    contact: float = 0.4
    """w_d: distance of the contact points from the surface [1/mm]."""
    quality: float = 2.0
    """w_q: all parts of the grasp quality."""
    centroid: float = 0.06
    """w_1 of Eq. III.9: distance of the contacts' middle from the centre of mass [1/mm]."""
    cone: float = 4.0
    """w_2 of Eq. III.9: angles between contact lines and normals beyond the cones [1/rad]."""
    balance: float = 8.0
    """Part of the grasp quality: wrench that the best balanced normal forces of sum one leave."""
    facing: float = 4.0
    """Cost of a contact that presses with the wrong side of the skin, as part of E_d [mm]."""
    penalty: float = 10.0
    """d of Eq. III.7."""
    depth_slope: float = 0.5
    """Graded part of the penalty [1/mm]."""
    tolerance: float = 0.0015
    """Depth in the grasp that is no collision yet: fingers are soft [m]."""
    clearance: float = 0.008
    """Room that a grasp leaves to other things [m]: fingers open to let go."""
    cone_share: float = 0.25
    """Share of the friction that contacts may need."""
    skin_points: int = 320
    """Points of the skin that are tested for collision."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for option in fields(self):
            value = getattr(self, option.name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{option.name} is {value}; expected a finite number >= 0")
        if self.skin_points < 1:
            raise InputError(f"skin_points is {self.skin_points}; expected at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What the user asks of the grasp, for E_c; in the object's frame."""

    contact_points: Float | None = None
    """Where the grip mode's contacts should be [m], shape (ncontact, 3); NaN leaves one open."""
    hand_pose: Float | None = None
    """Hand at the grasp, such as a tracked one, shape (28,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """What the objective says about every particle."""

    terms: dict[str, Float]
    """Weighted terms by name of `TERMS`, each (nparticle,)."""
    total: Float
    """Their sum, shape (nparticle,)."""
    points: Float
    """Contacts on the surface [m], object's frame, shape (nparticle, ncontact, 3); those that a
    grip mode lacks are 0."""
    normals: Float
    """Outward normals there, shape (nparticle, ncontact, 3)."""
    depths: Float
    """Deepest overlap with object or table per frame [m], shape (nparticle, nframe)."""


class GraspObjective:
    """Scores closing motions of one hand about one object."""

    def __init__(
        self,
        grips: GripDevice,
        field: DistanceField,
        *,
        friction: float,
        table: ArrayLike = NO_TABLE,
        wish: Wish | None = None,
        room: Callable[[Float], Float] | None = None,
        config: ObjectiveConfig | None = None,
    ) -> None:
        """Upload the object.

        Args:
            grips: The hand and its grip modes.
            field: Signed distances of the object.
            friction: Sliding friction of the object.
            table: Up direction and height of the table along it [m], object's frame, shape (4,).
            wish: What the user asks for.
            room: Distance from other things [m], shape (n,), of a hand that holds the object, whose
                poses in the object's frame are of shape (n, 28).
            config: Weights.
        """
        self._room = room
        self.config = config if config is not None else ObjectiveConfig()
        self.wish = wish if wish is not None else Wish()
        self._grips, self._task = grips, _task(self.config, friction)
        self._task.grid = field.upload(grips.device)
        self._task.table = wp.vec4(*np.asarray(table, np.float64).tolist())

    def __call__(self, motions: Float, grips: ArrayLike, log_density: ArrayLike = 0.0) -> Scores:
        """Score motions.

        Args:
            motions: Hand poses in the object's frame, shape (nparticle, nframe, 28); the last frame
                is the grasping pose.
            grips: Number of each motion's grip mode, shape (nparticle,).
            log_density: ln pr of each motion's coordinates, shape (nparticle,).
        """
        density = np.broadcast_to(np.asarray(log_density, np.float64), (len(motions),))
        with self._borrowed(len(motions), motions.shape[1]) as batch:
            batch.bind(self._task, np.asarray(grips))
            batch.score(motions, density)
            prior, collision, contact, quality = batch.terms.T
            points, normals, depths = batch.points, batch.normals, batch.depths
        control = self.config.control * self._departure(points, motions[:, -1])
        collision = collision + self._crowding(motions[:, -1])
        values = (prior, control, collision, contact, quality)
        return Scores(
            terms=dict(zip(TERMS, values, strict=True)), total=np.sum(values, axis=0),
            points=points, normals=normals, depths=depths,
        )  # fmt: skip

    @contextmanager
    def costs(
        self, parts: Sequence[NDArray[np.intp]], *, nframe: int, R_object_up: Float,
        swarm: SwarmConfig,
    ) -> Iterator[list[Callable[[Float, Float], Float]]]:  # fmt: skip
        """Costs of coordinates, for `swarm.search`; one function for each thread.

        Args:
            parts: Numbers of the grip modes of each part's particles, each (nparticle,).
            nframe: Frames that are scored, at least two.
            R_object_up: Rotation from the upright frame to the object's, shape (3, 3).
            swarm: Spread of the placements, for their prior.
        """
        placing: Any = Placing()
        placing.upright = wp.vec4(*matrix_to_quat(R_object_up).tolist())
        placing.offset_spread, placing.tilt_spread = swarm.offset_spread, swarm.tilt_spread
        batches = [self._grips.borrow(len(part), nframe) for part in parts]
        try:
            for batch, part in zip(batches, parts, strict=True):
                batch.bind(self._task, part, placing)
            yield [self._cost(batch) for batch in batches]
        finally:
            for batch in batches:
                self._grips.give_back(batch)

    def _cost(self, batch: ScoreBatch) -> Callable[[Float, Float], Float]:
        wished = self.wish.contact_points is not None or self.wish.hand_pose is not None

        def cost(positions: Float, bounds: Float) -> Float:
            total = batch.search(positions, bounds)
            if wished:
                total += self.config.control * self._departure(batch.points, batch.grasping)
            if self._room is not None:
                total += self._crowding(batch.grasping)
            return total

        return cost

    @contextmanager
    def _borrowed(self, count: int, nframe: int) -> Iterator[ScoreBatch]:
        batch = self._grips.borrow(count, nframe)
        try:
            yield batch
        finally:
            self._grips.give_back(batch)

    def _departure(self, points: Float, poses: Float) -> Float:
        """E_c: mean distance from wanted contacts and from the wanted hand [cm]."""
        away = np.zeros(len(poses))
        if self.config.control == 0:
            return away
        if self.wish.contact_points is not None:
            wanted = np.asarray(self.wish.contact_points, np.float64)
            known = np.isfinite(wanted).all(-1)
            if known.any():
                off = points[:, : len(wanted)][:, known] - wanted[known]
                away += 100.0 * np.linalg.norm(off, axis=-1).mean(1)
        if self.wish.hand_pose is not None:
            off = keypoints(self._grips.hand, poses) - keypoints(
                self._grips.hand, self.wish.hand_pose
            )
            away += 100.0 * np.linalg.norm(off, axis=-1).mean(1)
        return away

    def _crowding(self, poses: Float) -> Float:
        """Cost of being too near to other things in the grasp: as much as of entering an object."""
        if self._room is None:
            return np.zeros(len(poses))
        config = self.config
        short = np.maximum(config.clearance - self._room(poses), 0.0)
        depth = config.depth_slope * 1e3 * short
        return config.collision * (config.penalty * (short > 0.0) + depth)


def _task(config: ObjectiveConfig, friction: float) -> Any:
    """Weights as the kernels take them: of metres and radians."""
    task: Any = GraspTask()
    task.cone = float(np.arctan(config.cone_share * friction))
    task.prior = config.prior
    task.collision = config.collision * config.penalty
    task.depth = config.collision * config.depth_slope * 1e3
    task.tolerance = config.tolerance
    task.contact = config.contact * 1e3
    task.facing = config.contact * config.facing
    task.centroid = config.quality * config.centroid * 1e3
    task.angle = config.quality * config.cone
    task.balance = config.quality * config.balance
    return task
