"""Synthesis of a whole grasping motion (thesis III.4): closing, then reaching, then manipulation.

Closing comes first, for its last frame is the grasp; reaching, manipulation and releasing are the
nearest recordings, edited to fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.clearance import Surroundings, clearance_points, cleared
from handtrack.grasp.closing import ClosingConfig, ClosingGrasp, ClosingSynthesizer
from handtrack.grasp.grip_device import GripDevice
from handtrack.grasp.limits import check_task, reason_against
from handtrack.grasp.mirror import (
    mirrored_field,
    mirrored_object,
    mirrored_object_poses,
    mirrored_plan,
    mirrored_wish,
)
from handtrack.grasp.motion_model import GraspMotionModel, GripModel
from handtrack.grasp.objective import Wish
from handtrack.grasp.obstacles import Obstacle, room_beside
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.recording import FRAME_RATE, GraspDatabase, grasp_yaw
from handtrack.grasp.trajectory import carried, reach, release, transport
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import moved_poses, quat_to_matrix

Float = NDArray[np.float64]

CARRY = (0.25, 0.0, 0.15)
"""Where an object is carried without a target, from where it stands [m]: aside and up."""

CLIMB = 0.1
"""Difference of height from which on a path needs no rise of its own [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthesisConfig:
    """Settings of the synthesis."""

    closing: ClosingConfig = field(default_factory=ClosingConfig)
    """Search for the grasp."""
    release: bool = False
    """Whether the hand lets go of the object at the target."""
    clear_height: float = 0.03
    """How far an object that is carried to its own height rises [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if not (np.isfinite(self.clear_height) and self.clear_height >= 0):
            raise InputError(f"clear_height is {self.clear_height} m; expected at least 0")


class GraspSynthesizer:
    """Plans grasps with one hand: the database and what is learnt from it are read once."""

    def __init__(
        self,
        hand: ShapedHand | None = None,
        *,
        database: GraspDatabase | None = None,
        model: GraspMotionModel | None = None,
        config: SynthesisConfig | None = None,
        device: str | None = None,
    ) -> None:
        """Read and learn.

        Args:
            hand: One person's hand; the mean right one by default.
            database: Recordings; those that come with handtrack by default.
            model: Motion model; learnt from the recordings by default.
            config: Settings.
            device: "cpu", "cuda:N" or None for the best there is.
        """
        self.hand = hand if hand is not None else HandModel.load().shaped()
        self._right = self.hand.as_right()
        self.database = database if database is not None else GraspDatabase.load()
        self.model = model if model is not None else GraspMotionModel.learn(self.database)
        self.config = config if config is not None else SynthesisConfig()
        self._skin = clearance_points(self._right)
        self.device = device
        self._grips = GripDevice(
            self._right, list(self.model.grips.values()), device=device,
            skin_points=self.config.closing.objective.skin_points,
        )  # fmt: skip

    def plan(
        self,
        body: RigidObject,
        *,
        grip: str = "auto",
        start: ArrayLike | None = None,
        place: ArrayLike | None = None,
        target: ArrayLike | None = None,
        wish: Wish | None = None,
        obstacles: Sequence[Obstacle] = (),
        distances: DistanceField | None = None,
        seed: int = 0,
    ) -> GraspPlan:
        """Plan how to take an object and bring it to a target.

        Args:
            body: The object.
            grip: Grip mode; "auto" chooses.
            start: The hand before, world, shape (28,); where recordings start by default.
            place: Pose of the object in the world, shape (7,); on the table at the origin by
                default.
            target: Where to bring it, shape (7,); aside and up by default.
            wish: What else the user asks for.
            obstacles: Other things, that the hand keeps clear of where it takes the object and
                where it brings it; not on its way.
            distances: Signed distances of the object; measured when absent.
            seed: Seed of the search.

        Raises:
            InputError: A pose is unusable, there is no such grip mode, or the object cannot be
                grasped or brought there; the message says why (`grasp.limits`).
        """
        here = _object_pose(place, (0.0, 0.0, body.rest_height), "place")
        there = _object_pose(target, here[:3] + CARRY, "target", here[3:])
        if start is not None:
            start = np.asarray(start, np.float64)
            if start.shape != (28,) or not np.isfinite(start).all():
                raise InputError(f"start has shape {start.shape}; expected 28 finite numbers")
        models = list(self.model.grips.values()) if grip == "auto" else [self.model[grip]]
        if distances is None:
            distances = DistanceField.of(body, device=self.device)
        if self.hand.side == "right":
            return self._plan(body, models, start, here, there, wish, obstacles, distances, seed)
        image = self._plan(
            mirrored_object(body), models, None if start is None else mirror_pose(start),
            mirrored_object_poses(here), mirrored_object_poses(there),
            None if wish is None else mirrored_wish(wish), [o.mirrored() for o in obstacles],
            mirrored_field(distances), seed,
        )  # fmt: skip
        return mirrored_plan(image)

    def _plan(
        self, body: RigidObject, models: list[GripModel], start: Float | None, here: Float,
        there: Float, wish: Wish | None, obstacles: Sequence[Obstacle], distances: DistanceField,
        seed: int,
    ) -> GraspPlan:  # fmt: skip
        """A right hand's plan."""

        def room(poses: Float) -> Float:
            both = [
                room_beside(self._right, self._skin, in_world(poses, at), obstacles)
                for at in (here, there)
            ]
            return np.minimum(*both)

        yaw = None
        if start is not None:
            yaw = grasp_yaw(start, here[:3])
        check_task(self._right, body, place=here, target=there, start=start)
        grasp = ClosingSynthesizer(
            self._right, body, distances, models, place=here, yaw=yaw, wish=wish,
            room=room if obstacles else None, config=self.config.closing, grips=self._grips,
        ).run(seed)  # fmt: skip
        if not grasp.feasible:
            raise InputError(self._reason(grasp, body, here, distances))
        return self._compose(grasp, start, here, there, distances)

    def _reason(
        self, grasp: ClosingGrasp, body: RigidObject, here: Float, distances: DistanceField
    ) -> str:
        """Why the best grasp that was found cannot carry the object."""
        pads, closing = grasp.pads, self.config.closing
        placed = BonePoints(bones=pads.bones, offsets=pads.points).place(
            self._right, grasp.motion[-1]
        )
        return reason_against(
            body, grasp.points, grasp.normals, distances.distance(placed),
            friction=closing.friction_shares[-1] * body.friction, load=closing.load,
            gravity=-9.81 * quat_to_matrix(here[3:])[2],
        )  # fmt: skip

    def _compose(
        self, grasp: ClosingGrasp, start: Float | None, here: Float, there: Float,
        distances: DistanceField,
    ) -> GraspPlan:  # fmt: skip
        """All phases in the world at the recordings' frame rate."""
        closing = in_world(grasp.motion, here)
        way = reach(self.database, grasp.grip, start, closing, FRAME_RATE)
        way = cleared(way, Surroundings(self._right, distances, here, skin=self._skin))
        path = transport(self.database, here, there, FRAME_RATE)
        path[:, 2] += _lift(path, self.config.clear_height)
        hands = [way[:-1], closing, carried(closing[-1], path)[1:]]
        things = [
            np.tile(here, (len(way) - 1 + len(closing), 1)),
            path[1:],
        ]
        names = ["reaching"] * (len(way) - 1) + ["closing"] * len(closing)
        names += ["manipulation"] * (len(path) - 1)
        if self.config.release:
            back = release(self.database, grasp.grip, hands[-1][-1], FRAME_RATE)
            around = Surroundings(self._right, distances, there, skin=self._skin)
            back = cleared(back[::-1], around)[::-1][1:]
            hands.append(back)
            things.append(np.tile(there, (len(back), 1)))
            names += ["releasing"] * len(back)
        poses = np.concatenate(hands)
        return GraspPlan(
            grip=grasp.grip,
            times=np.arange(len(poses)) / FRAME_RATE,
            hand_poses=poses,
            object_poses=np.concatenate(things),
            phases=np.array(names),
            contact_bones=grasp.pads.bones,
            contact_local=grasp.pads.points,
            contact_points=grasp.points,
            contact_normals=grasp.normals,
            feasible=grasp.feasible,
            costs=grasp.costs,
        )


def synthesize_grasp(
    body: RigidObject,
    *,
    grip: str = "auto",
    start: ArrayLike | None = None,
    place: ArrayLike | None = None,
    target: ArrayLike | None = None,
    hand: ShapedHand | None = None,
    model: GraspMotionModel | None = None,
    config: SynthesisConfig | None = None,
    seed: int = 0,
    device: str | None = None,
) -> GraspPlan:
    """Plan one grasp; `GraspSynthesizer` says what the arguments are, and is quicker for many."""
    planner = GraspSynthesizer(hand, model=model, config=config, device=device)
    return planner.plan(body, grip=grip, start=start, place=place, target=target, seed=seed)


def in_world(poses: ArrayLike, place: ArrayLike) -> Float:
    """Hand poses of an object's frame in the world.

    Args:
        poses: Hand in the object's frame, shape (n, 28).
        place: The object in the world, shape (7,).
    """
    at = np.asarray(place, np.float64)
    return moved_poses(poses, quat_to_matrix(at[3:]), at[:3])


def _object_pose(
    given: ArrayLike | None, centre: ArrayLike, name: str, quat: ArrayLike = (1.0, 0.0, 0.0, 0.0)
) -> Float:
    """A given pose of the object, or one with this centre and quaternion, shape (7,)."""
    if given is None:
        return np.concatenate([np.asarray(centre, np.float64), np.asarray(quat, np.float64)])
    pose = np.array(given, np.float64)
    if pose.shape != (7,) or not np.isfinite(pose).all() or np.linalg.norm(pose[3:]) < 1e-6:
        raise InputError(f"{name} has shape {pose.shape}; expected 3 metres and a quaternion")
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose


def _lift(path: Float, height: float) -> Float:
    """What is added to the height of a path, ends unchanged, shape (n,).

    A path to about the same height rises over both ends, so that what is carried neither scrapes
    along the table nor runs into what it is to stand on; one that climbs anyway rises less.
    """
    share = np.linspace(0.0, 1.0, len(path))
    climb = abs(path[-1, 2] - path[0, 2])
    wanted = max(path[0, 2], path[-1, 2]) + height * max(1.0 - climb / CLIMB, 0.0)
    short = wanted - path[:, 2].max() if climb < CLIMB else 0.0
    return max(short, 0.0) * 16.0 * share**2 * (1.0 - share) ** 2
