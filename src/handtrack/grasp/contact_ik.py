"""Pulling contacts onto the object: the inverse kinematics that ends a synthesis (III.4.1.4).

Damped Gauss-Newton on the 27 increments of several poses at once, so that the best particles of a
swarm can all be finished and then compared: contacts go to the surface, skin out of the object and
off the table, joints stay within their limits, and all else stays near to where the swarm left it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.taxonomy import DIP_SHARE, GripPads
from handtrack.hand.inverse_kinematics import BonePoints, jacobian_of_frames
from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import ANGLES, FINGERS, NBONE, NV
from handtrack.objects.distance_field import DistanceField
from handtrack.transforms import apply_increment, pose_difference

Float = NDArray[np.float64]

COUPLED = np.array([
    (6 + ANGLES.index(f"{finger}_pip_flexion"), 6 + ANGLES.index(f"{finger}_dip_flexion"))
    for finger in FINGERS[1:]
])  # fmt: skip
"""Increments of the joints that one tendon bends together, shape (4, 2)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactIkConfig:
    """Settings of the pull."""

    iterations: int = 12
    """Gauss-Newton steps."""
    depth: float = 0.0005
    """How deep a contact is to sit in the object [m]."""
    pad_radius: float = 0.012
    """Skin so near to a contact may be as deep as it [m]; other skin stays out."""
    table_clearance: float = 0.002
    """Skin stays this far above the table [m]."""
    overlap_weight: float = 1.0
    """Weight of skin inside the object or the table, against that of contacts of 1."""
    square_weight: float = 1e-5
    """Weight of how far a contact's skin is from lying flat on the surface [m^2]."""
    palm_weights: tuple[float, float] = (0.001, 1e-6)
    """Weights of moving [1] and turning [m^2/rad^2] the palm."""
    angle_weight: float = 1e-6
    """Weight of leaving the first angles [m^2/rad^2]."""
    coupling_weight: float = 2e-6
    """Weight of bending the end joint by other than two thirds of the middle joint [m^2/rad^2]."""
    nearest: int = 200
    """So many points of the skin, the nearest to object and table, are looked at in every step."""
    renewal: int = 6
    """Steps after which the nearest are chosen anew."""
    deepest: int = 24
    """So many of them, the deepest in the object and in the table, push in one step."""
    longest_step: float = 1.0
    """Longest step of any angle [rad]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        for option in fields(self):
            values = np.ravel(getattr(self, option.name))
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise InputError(f"{option.name} is {getattr(self, option.name)}; expected >= 0")
        if min(self.iterations, self.nearest, self.renewal, self.deepest) < 1:
            raise InputError("iterations, nearest, renewal and deepest must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Pulled:
    """Poses whose contacts were pulled onto the surface."""

    poses: Float
    """Hand in the object's frame, shape (n, 28)."""
    gaps: Float
    """Signed distances of the contacts from the surface [m], NaN for none, shape (n, ncontact)."""
    depths: Float
    """Deepest place of the skin in the object or the table [m], shape (n,)."""
    surface: Float
    """Contacts on the surface [m], shape (n, ncontact, 3)."""
    normals: Float
    """Outward normals there, shape (n, ncontact, 3)."""


def pull_contacts(
    hand: ShapedHand,
    poses: ArrayLike,
    pads: Sequence[GripPads],
    field: DistanceField,
    *,
    table: ArrayLike,
    config: ContactIkConfig | None = None,
) -> Pulled:
    """The poses nearby whose contacts touch and whose skin stays outside.

    Args:
        hand: The hand.
        poses: Where to start, object's frame, shape (n, 28).
        pads: Contacts of each pose's grip mode, n of them.
        field: Signed distances of the object.
        table: Up direction and height of the table [m], object's frame, shape (4,).
        config: Settings.

    Raises:
        InputError: There is not one grip for each pose.
    """
    poses = np.asarray(poses, np.float64)
    if poses.ndim != 2 or poses.shape[1] != 28 or len(pads) != len(poses):
        raise InputError(
            f"poses have shape {poses.shape} and there are {len(pads)} grips; expected (n, 28) and "
            "one grip for each pose"
        )
    task = _Task(hand, poses, pads, field, np.asarray(table, np.float64), config)
    return task.solve()


def blend_correction(motion: ArrayLike, final: ArrayLike, *, start: float = 0.3) -> Float:
    """Closing motions whose last frame becomes `final`, their start staying, (..., nframe, 28).

    Args:
        motion: Hand poses, shape (..., nframe, 28).
        final: The corrected last poses, shape (..., 28).
        start: Share of the motion after which the correction sets in.
    """
    motion = np.asarray(motion, np.float64)
    change = pose_difference(final, motion[..., -1, :])
    times = np.linspace(0.0, 1.0, motion.shape[-2])
    share = np.clip((times - start) / (1.0 - start), 0.0, 1.0)
    eased = share**2 * (3.0 - 2.0 * share)
    return apply_increment(motion, eased[:, None] * change[..., None, :])


class _Task:
    """One batch of poses and all that stays while it is solved."""

    def __init__(
        self, hand: ShapedHand, poses: Float, pads: Sequence[GripPads], field: DistanceField,
        table: Float, config: ContactIkConfig | None,
    ) -> None:  # fmt: skip
        self.config = config or ContactIkConfig()
        self.hand, self.field, self.first = hand, field, poses
        self.up, self.height = table[:3], float(table[3])
        count, most = len(poses), max((len(pad.bones) for pad in pads), default=0)
        self.bones = np.zeros((count, most), np.int64)
        self.there = np.zeros((count, most), bool)
        self.points, self.presses = np.zeros((2, count, most, 3))
        for k, pad in enumerate(pads):
            size = len(pad.bones)
            self.bones[k, :size], self.there[k, :size] = pad.bones, True
            self.points[k, :size], self.presses[k, :size] = pad.points, pad.normals
        self.skin = _whole_skin(hand)
        self.hold = np.full(NV, self.config.angle_weight)
        self.hold[:3], self.hold[3:6] = self.config.palm_weights
        self.allowances = self._allowances()
        self._watch(poses)

    def _allowances(self) -> Float:
        """How deep each skin point may be [m], shape (n, nskin)."""
        near = np.zeros((len(self.first), len(self.skin.bones)), bool)
        for k in range(self.bones.shape[1]):
            away = np.linalg.norm(self.skin.offsets - self.points[:, k, None], axis=2)
            same = self.skin.bones == self.bones[:, k, None]
            near |= self.there[:, k, None] & same & (away < self.config.pad_radius)
        return np.where(near, self.config.depth, 0.0)

    def solve(self) -> Pulled:
        """Take all steps; each pose keeps the best that it was."""
        count = len(self.first)
        current, best = self.first.copy(), self.first.copy()
        energy, damping = np.full(count, np.inf), np.full(count, 1e-3)
        system, slope = np.zeros((count, NV, NV)), np.zeros((count, NV))
        low, high = self.hand.limits.T
        diagonal = np.arange(NV)
        for step in range(self.config.iterations):
            if step % self.config.renewal == 0 and step > 0:
                self._watch(best)
                energy[:] = np.inf  # of other skin
                current = best
            rows, residuals = self._linearised(current)
            found = (residuals**2).sum(1)
            better = found < energy
            turned = np.swapaxes(rows[better], 1, 2)
            system[better] = turned @ rows[better]
            slope[better] = (turned @ residuals[better, :, None])[..., 0]
            best[better], energy[better] = current[better], found[better]
            damping = np.clip(np.where(better, 0.3 * damping, 8.0 * damping), 1e-6, 1e3)
            damped = system.copy()
            damped[:, diagonal, diagonal] *= 1.0 + damping[:, None]
            damped[:, diagonal, diagonal] += 1e-9
            move = -np.linalg.solve(damped, slope[..., None])[..., 0]
            longest = np.abs(move[:, 3:]).max(1, keepdims=True, initial=1e-12)
            move *= np.minimum(1.0, self.config.longest_step / longest)
            current = apply_increment(best, move)
            current[:, 7:] = current[:, 7:].clip(low, high)
        return self._told(best)

    def _skin(self, rotations: Float, origins: Float) -> Float:
        """All skin [m], shape (n, nvert, 3)."""
        placed = np.empty((len(rotations), len(self.skin.bones), 3))
        for bone in range(NBONE):
            own = slice(*np.searchsorted(self.skin.bones, (bone, bone + 1)))
            turned = self.skin.offsets[own] @ np.swapaxes(rotations[:, bone], 1, 2)
            placed[:, own] = turned + origins[:, bone, None]
        return placed

    def _clear(self, points: Float) -> Float:
        """Room of skin from object and table [m], shape (n, nskin)."""
        return np.minimum(self.field.distance(points), points @ self.up - self.height)

    def _watch(self, poses: Float) -> None:
        """Choose the skin that is looked at in the next steps."""
        placed = self._skin(*bone_frames(self.hand, poses))
        most = min(self.config.nearest, placed.shape[1])
        chosen = np.argpartition(self._clear(placed), most - 1, axis=1)[:, :most]
        self.watched_bones = self.skin.bones[chosen]
        self.watched = self.skin.offsets[chosen]
        self.allowed = np.take_along_axis(self.allowances, chosen, axis=1)

    def _linearised(self, poses: Float) -> tuple[Float, Float]:
        """Weighted rows (n, nrow, 27) and residuals (n, nrow) of all that is asked."""
        config, count = self.config, len(poses)
        rotations, origins = bone_frames(self.hand, poses)
        contacts = _on_bones(rotations, origins, self.bones, self.points)
        placed = _on_bones(rotations, origins, self.watched_bones, self.watched)
        each = np.arange(count)[:, None]
        over = np.minimum(self.field.distance(placed) + self.allowed, 0.0)
        sunk = np.minimum(placed @ self.up - self.height - config.table_clearance, 0.0)
        most = min(config.deepest, placed.shape[1])
        inside = np.argpartition(over, most - 1, axis=1)[:, :most]
        under = np.argpartition(sunk, most - 1, axis=1)[:, :most]
        pushed = np.concatenate([inside, under], axis=1)
        # A press direction turns like a point one metre out minus the bone's origin.
        press = (rotations[each, self.bones] @ self.presses[..., None])[..., 0]
        points = np.concatenate([contacts, contacts + press, placed[each, pushed]], axis=1)
        bones = np.concatenate(
            [self.bones, self.bones, np.take_along_axis(self.watched_bones, pushed, axis=1)], axis=1
        )
        jacobian = jacobian_of_frames(self.hand, poses, rotations, origins, bones, points)
        size = contacts.shape[1]
        normals = self.field.normal(np.concatenate([contacts, placed[each, inside]], axis=1))
        touch, push = normals[:, :size], normals[:, size:]
        known = self.there[..., None]
        sink = jacobian[:, 2 * size + most :]
        rows = [
            known * np.einsum("nci,ncij->ncj", touch, jacobian[:, :size]),
            np.sqrt(config.square_weight)
            * (known[..., None] * (jacobian[:, size : 2 * size] - jacobian[:, :size])).reshape(
                count, -1, NV
            ),
            np.sqrt(config.overlap_weight)
            * np.einsum("nci,ncij->ncj", push, jacobian[:, 2 * size : 2 * size + most])
            * (over[each, inside] < 0)[..., None],
            np.sqrt(config.overlap_weight)
            * np.einsum("i,ncij->ncj", self.up, sink)
            * (sunk[each, under] < 0)[..., None],
            np.broadcast_to(np.diag(np.sqrt(self.hold)), (count, NV, NV)),
            np.broadcast_to(np.sqrt(config.coupling_weight) * _coupling_rows(), (count, 4, NV)),
        ]
        residuals = [
            self.there * (self.field.distance(contacts) + config.depth),
            np.sqrt(config.square_weight) * (known * (press + touch)).reshape(count, -1),
            np.sqrt(config.overlap_weight) * over[each, inside],
            np.sqrt(config.overlap_weight) * sunk[each, under],
            np.sqrt(self.hold) * pose_difference(poses, self.first),
            np.sqrt(config.coupling_weight) * poses[:, 7:] @ _coupling_rows()[:, 6:].T,
        ]
        return np.concatenate(rows, axis=1), np.concatenate(residuals, axis=1)

    def _told(self, poses: Float) -> Pulled:
        rotations, origins = bone_frames(self.hand, poses)
        contacts = _on_bones(rotations, origins, self.bones, self.points)
        gaps, normals = self.field.distance(contacts), self.field.normal(contacts)
        return Pulled(
            poses=poses,
            gaps=np.where(self.there, gaps, np.nan),
            # Here skin bends: near bent joints it is millimetres from where rigid skin would be.
            depths=np.maximum(-self._clear(skin(self.hand, poses)).min(1), 0.0),
            surface=contacts - gaps[..., None] * normals,
            normals=normals,
        )


def _whole_skin(hand: ShapedHand) -> BonePoints:
    """All vertices, each on the bone that moves it most, sorted by bone."""
    whole = BonePoints.of_skin(hand, np.arange(hand.nvert))
    order = np.argsort(whole.bones, kind="stable")
    return BonePoints(bones=whole.bones[order], offsets=whole.offsets[order])


def _on_bones(rotations: Float, origins: Float, bones: NDArray[np.int64], points: Float) -> Float:
    """Points of bone frames (n, m, 3), each on its own bone (n, m), where they are [m]."""
    each = np.arange(len(bones))[:, None]
    return (rotations[each, bones] @ points[..., None])[..., 0] + origins[each, bones]


def _coupling_rows() -> Float:
    """Derivative of how far end joints are from two thirds of the middle joints, shape (4, 27)."""
    rows = np.zeros((len(COUPLED), NV))
    each = np.arange(len(COUPLED))
    rows[each, COUPLED[:, 0]], rows[each, COUPLED[:, 1]] = -DIP_SHARE, 1.0
    return rows
