"""What a good closing motion is: the objective of Eq. III.4, for motions of all grip modes at once.

The thesis gives weights but no units: lengths count here in millimetres (in centimetres in the
control term), angles in radians. Three things go beyond it: the table counts like the object; the
collision penalty also grows with the depth, so that a swarm feels which way is out; and contacts
must press with the side of the skin that the grip mode presses with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.grasp.skin_points import SkinPoints
from handtrack.grasp.taxonomy import GripPads
from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NANGLE, NBONE, NQ
from handtrack.kernels.grasp_score import measure_overlaps, score_contacts
from handtrack.kernels.kinematics import pose_bones
from handtrack.objects.distance_field import DistanceField

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
    """w_q: both parts of the grasp quality."""
    centroid: float = 0.06
    """w_1 of Eq. III.9: distance of the contacts' middle from the centre of mass [1/mm]."""
    cone: float = 4.0
    """w_2 of Eq. III.9: angles between contact lines and normals beyond the cones [1/rad]."""
    facing: float = 4.0
    """Cost of a contact that presses with the wrong side of the skin, as part of E_d [mm]."""
    penalty: float = 10.0
    """d of Eq. III.7."""
    depth_slope: float = 0.5
    """Graded part of the penalty [1/mm]."""
    tolerance: float = 0.0015
    """Depth in the grasp that is no collision yet: fingers are soft [m]."""
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
        hand: ShapedHand,
        grips: Sequence[GripPads],
        field: DistanceField,
        *,
        friction: float,
        table: ArrayLike = NO_TABLE,
        wish: Wish | None = None,
        config: ObjectiveConfig | None = None,
        device: str | None = None,
    ) -> None:
        """Upload what does not change.

        Args:
            hand: The hand.
            grips: Where each grip mode touches.
            field: Signed distances of the object.
            friction: Sliding friction of the object.
            table: Up direction and height of the table along it [m], object's frame, shape (4,).
            wish: What the user asks for.
            config: Weights.
            device: "cpu", "cuda:N" or None for the best there is.

        Raises:
            InputError: There are no grip modes.
        """
        if not grips:
            raise InputError("no grip modes are given; expected at least one")
        self.config = config if config is not None else ObjectiveConfig()
        self.hand, self.wish = hand, wish if wish is not None else Wish()
        self._device = resolve_device(device)
        self._hand = DeviceHand.upload([hand], self._device)
        self._put_skin(SkinPoints.of(hand, self.config.skin_points))
        self._grid = field.upload(self._device)
        a, b, c, height = np.asarray(table, np.float64).tolist()
        self._table = (a, b, c, height)
        self._cone = float(np.arctan(self.config.cone_share * friction))
        self._put_contacts(grips)
        self._work: _Workspace | None = None

    def _put_skin(self, skin: SkinPoints) -> None:
        self._skin = (
            wp.array(skin.group_bones.astype(np.int32), dtype=int, device=self._device),
            wp.array(skin.group_starts.astype(np.int32), dtype=int, device=self._device),
            wp.array(skin.group_centres.astype(np.float32), dtype=wp.vec3, device=self._device),
            wp.array(skin.group_radii.astype(np.float32), dtype=float, device=self._device),
            wp.array(skin.points.offsets.astype(np.float32), dtype=wp.vec3, device=self._device),
        )

    def _put_contacts(self, grips: Sequence[GripPads]) -> None:
        self.ncontact = max(len(grip.bones) for grip in grips)
        shape = (len(grips), self.ncontact)
        bones = np.full(shape, -1, np.int32)
        points, normals = np.zeros((2, *shape, 3), np.float32)
        pairs = np.full((len(grips), max(len(g.pairs) for g in grips), 2), -1, np.int32)
        for k, grip in enumerate(grips):
            count = len(grip.bones)
            bones[k, :count], points[k, :count] = grip.bones, grip.points
            normals[k, :count], pairs[k, : len(grip.pairs)] = grip.normals, grip.pairs
        self._contacts = (
            wp.array(bones, dtype=int, device=self._device),
            wp.array(points, dtype=wp.vec3, device=self._device),
            wp.array(normals, dtype=wp.vec3, device=self._device),
            wp.array(pairs, dtype=int, device=self._device),
        )

    def __call__(self, motions: Float, grips: ArrayLike, log_density: ArrayLike = 0.0) -> Scores:
        """Score motions.

        Args:
            motions: Hand poses in the object's frame, shape (nparticle, nframe, 28); the last frame
                is the grasping pose.
            grips: Number of each motion's grip mode, shape (nparticle,).
            log_density: ln pr of each motion's coordinates, shape (nparticle,).
        """
        count, nframe = motions.shape[:2]
        if self._work is None or not self._work.fits(count, nframe):
            self._work = _Workspace(count, nframe, self.ncontact, self._device)
        work, hand = self._work, self._hand
        work.pose.assign(motions.reshape(-1, NQ).astype(np.float32))
        work.grips.assign(np.asarray(grips, np.int32))
        pose_bones(
            hand.bone_rotations, hand.bone_origins, hand.bone_parents, hand.bone_angles,
            hand.angle_axes, work.row_hand, work.pose,
            rotations=work.rotations, origins=work.origins, axes=work.axes,
        )  # fmt: skip
        measure_overlaps(
            *self._skin, self._grid, self._table, work.rotations, work.origins,
            depths=work.depths,
        )  # fmt: skip
        score_contacts(
            *self._contacts, self._grid, work.grips, work.rotations, work.origins, nframe=nframe,
            cone=self._cone, points=work.points, normals=work.normals, scores=work.scores,
        )  # fmt: skip
        depths = work.depths.numpy().astype(np.float64).reshape(count, nframe)
        points = work.points.numpy().astype(np.float64)
        terms = self._weighed(depths, work.scores.numpy().astype(np.float64))
        density = np.broadcast_to(np.asarray(log_density, np.float64), (count,))
        terms["prior"] = -self.config.prior * density
        terms["control"] = self.config.control * self._departure(points, motions[:, -1])
        return Scores(
            terms={name: terms[name] for name in TERMS},
            total=np.sum([terms[name] for name in TERMS], axis=0),
            points=points,
            normals=work.normals.numpy().astype(np.float64),
            depths=depths,
        )

    def _weighed(self, depths: Float, scores: Float) -> dict[str, Float]:
        """The three terms that the kernels measure."""
        config = self.config
        distance, centroid, angles, facing = scores.T
        allowed = np.zeros(depths.shape[1])
        allowed[-1] = config.tolerance  # no finger touches before the grasp
        over = np.maximum(depths - allowed, 0.0)
        pene = config.penalty * (over > 0) + config.depth_slope * 1e3 * over
        return {
            "collision": config.collision * pene.mean(1),
            "contact": config.contact * (1e3 * distance + config.facing * facing),
            "quality": config.quality * (config.centroid * 1e3 * centroid + config.cone * angles),
        }

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
            off = keypoints(self.hand, poses) - keypoints(self.hand, self.wish.hand_pose)
            away += 100.0 * np.linalg.norm(off, axis=-1).mean(1)
        return away


class _Workspace:
    """Arrays of one batch size on the device."""

    def __init__(self, count: int, nframe: int, ncontact: int, device: wp.Device) -> None:
        rows, self._size = count * nframe, (count, nframe)

        def make(shape: tuple[int, ...] | int, dtype: type) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.pose, self.row_hand = make((rows, NQ), float), make(rows, int)
        self.rotations = make((rows, NBONE), wp.mat33)
        self.origins = make((rows, NBONE), wp.vec3)
        self.axes = make((rows, NANGLE), wp.vec3)
        self.depths = make(rows, float)
        self.grips = make(count, int)
        self.points = make((count, ncontact), wp.vec3)
        self.normals = make((count, ncontact), wp.vec3)
        self.scores = make((count, 4), float)

    def fits(self, count: int, nframe: int) -> bool:
        """Whether it is of this size."""
        return self._size == (count, nframe)
