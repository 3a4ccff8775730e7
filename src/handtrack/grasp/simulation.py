"""A planned grasp carried out under physics (thesis III.5), step by step, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.controller import ControlConfig, GraspController, Target, Variant
from handtrack.grasp.penetration import skin_depths
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.reference import Reference, Stage, reference
from handtrack.grasp.run import Goal, GraspRun
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import sphere
from handtrack.physics.bone_solids import BoneSolid
from handtrack.physics.hand_body import Layout
from handtrack.physics.scene import Scene, SceneConfig

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationConfig:
    """Settings of a simulated grasp."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    layout: Layout = "tracking"
    goal: Goal = field(default_factory=Goal)
    take_time: float = 0.4
    """Pause after closing in which the fingers take hold [s]."""
    record_interval: int = 10
    """Steps between recorded states."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FallingBall:
    """A ball that falls on what the hand holds (thesis III.8.3)."""

    mass: float
    """Mass [kg]."""
    height: float = 0.2
    """How far above the object it starts [m]."""
    time: float = 1.0
    """When it starts, from the start of the hold [s]."""
    offset: tuple[float, float] = (0.0, 0.0)
    """Where it falls beside the object's centre of mass [m]."""
    radius: float = 0.015
    """Radius [m]."""


def simulate(
    plan: GraspPlan,
    thing: RigidObject,
    *,
    hand: ShapedHand,
    controller: Variant = "full",
    config: SimulationConfig | None = None,
    balls: Sequence[FallingBall] = (),
    mass: float | None = None,
    friction: float | None = None,
    distances: DistanceField | None = None,
    solids: tuple[BoneSolid, ...] | None = None,
) -> GraspRun:
    """Carry a plan out.

    Args:
        plan: What to do.
        thing: The object in the world; may be another than the plan was made for.
        hand: The hand.
        controller: Which controller drives it.
        config: Settings.
        balls: Balls that fall on the object.
        mass: Mass of the object in the world [kg]; the controller knows it.
        friction: Its friction, likewise.
        distances: Distance field of the object, for how deep the skin enters; made when absent.
        solids: `bone_solids` of the hand; made when absent.
    """
    config = config or SimulationConfig()
    changed = {k: v for k, v in (("mass", mass), ("friction", friction)) if v is not None}
    thing = replace(thing, **changed) if changed else thing
    spheres = [_ball(ball) for ball in balls]
    scene = Scene(hand, [thing, *spheres], layout=config.layout, solids=solids, config=config.scene)
    start = plan.object_poses[0].copy()
    # Another object than the plan's stands on the table all the same.
    start[2] = max(start[2], thing.rest_height)
    scene.set_object(0, start)
    for k, ball in enumerate(balls):  # out of the way until they fall
        scene.set_object(1 + k, (3.0 + k, 3.0, ball.radius, 1.0, 0.0, 0.0, 0.0))
    scene.set_hand(plan.hand_poses[0])
    return _carry_out(scene, plan, 0, controller, config, balls, distances)


def simulate_sequence(
    plans: Sequence[tuple[int, GraspPlan]],
    things: Sequence[RigidObject],
    starts: ArrayLike,
    *,
    hand: ShapedHand,
    controller: Variant = "full",
    config: SimulationConfig | None = None,
    solids: tuple[BoneSolid, ...] | None = None,
) -> tuple[list[GraspRun], Float]:
    """Carry plans out one after another in one world, such as blocks that are stacked.

    Args:
        plans: Which object each plan grasps, and the plan; each starts where the one before ends.
        things: The objects.
        starts: Where they stand at first, shape (nobject, 7).
        hand: The hand.
        controller: Which controller drives it.
        config: Settings.
        solids: `bone_solids` of the hand; made when absent.

    Returns:
        A run for every plan, and where the objects are when all is over, shape (nobject, 7).
    """
    config = config or SimulationConfig()
    scene = Scene(hand, things, layout=config.layout, solids=solids, config=config.scene)
    for k, start in enumerate(np.asarray(starts, np.float64)):
        scene.set_object(k, start)
    if plans:
        scene.set_hand(plans[0][1].hand_poses[0])
    runs = [_carry_out(scene, plan, index, controller, config, (), None) for index, plan in plans]
    ends = [scene.object_pose(k) for k in range(len(things))]
    return runs, np.array(ends).reshape(-1, 7)


def _carry_out(
    scene: Scene,
    plan: GraspPlan,
    index: int,
    controller: Variant,
    config: SimulationConfig,
    balls: Sequence[FallingBall],
    distances: DistanceField | None,
) -> GraspRun:
    """Follow a plan from the scene's state to its end; balls are the objects after the first."""
    path = reference(
        plan.times, plan.hand_poses, plan.object_poses, plan.phases,
        timestep=config.scene.timestep, take_time=config.take_time, hold_time=config.goal.hold,
    )  # fmt: skip
    control = GraspController(
        scene, plan.contact_bones, plan.contact_points, plan.contact_normals, index=index,
        variant=controller, config=config.control,
    )  # fmt: skip
    hands = scene.layout.qpos(path.hand_poses)
    rates = scene.layout.velocity(path.hand_poses, path.hand_velocities)
    log = _Log(scene, path, index, config.record_interval, range(1, 1 + len(balls)))
    hold = path.times[path.holding][0] if path.holding.any() else np.inf
    waiting = sorted(range(len(balls)), key=lambda k: -balls[k].time)
    started = time.perf_counter()
    for k in range(len(path.times)):
        while waiting and path.times[k] >= hold + balls[waiting[-1]].time:
            _drop(scene, balls[waiting[-1]], waiting[-1])
            waiting.pop()
        target = Target(
            hand=hands[k], hand_velocity=rates[k], thing=path.object_poses[k],
            thing_velocity=path.object_velocities[k], stage=Stage(path.stages[k]),
        )  # fmt: skip
        scene.apply(control.torques(target))
        scene.step()
        log.note(k)
    wall_time = time.perf_counter() - started
    field = distances or DistanceField.of(scene.objects[index])
    return log.result(wall_time, np.array(control.force_times), config.goal, field)


def _ball(ball: FallingBall) -> RigidObject:
    return RigidObject.of_shape(sphere(2.0 * ball.radius), name="ball", mass=ball.mass)


def _drop(scene: Scene, ball: FallingBall, index: int) -> None:
    pose = scene.object_pose(0)
    place = pose[:3] + np.array([*ball.offset, ball.height])
    scene.set_object(1 + index, (*place, 1.0, 0.0, 0.0, 0.0))


class _Log:
    """What a run leaves behind, noted as it goes."""

    def __init__(
        self, scene: Scene, path: Reference, index: int, interval: int, balls: Sequence[int]
    ) -> None:
        if interval < 1:
            raise InputError(f"record_interval is {interval}; expected at least 1")
        self._scene, self._path, self._index = scene, path, index
        self._interval, self._balls = interval, balls
        self._steps: list[int] = []
        self._hands: list[Float] = []
        self._places: list[Float] = []
        self._forces: list[Float] = []
        self._supported: list[bool] = []
        self._depth = 0.0
        self._driven = False

    def note(self, step: int) -> None:
        """Note the state after a step."""
        self._depth = max(self._depth, self._scene.contact_depth(self._index))
        if step % self._interval:
            return
        contacts = self._scene.contacts(self._index)
        press = np.einsum("ni,ni->n", contacts.forces, contacts.normals)
        self._steps.append(step)
        self._hands.append(self._scene.hand_pose())
        count = len(self._scene.objects)
        self._places.append(np.array([self._scene.object_pose(k) for k in range(count)]))
        self._forces.append(np.bincount(contacts.bones, press, NBONE).astype(np.float64))
        self._supported.append(self._scene.supported(self._index, besides=self._balls))
        self._driven |= self._scene.objects_driven()

    def result(
        self, wall_time: float, force_times: Float, goal: Goal, field: DistanceField
    ) -> GraspRun:
        """The whole run."""
        steps = np.array(self._steps)
        hands, places = np.array(self._hands), np.array(self._places)
        things = places[:, self._index]
        return GraspRun(
            times=self._path.times[steps],
            hand_poses=hands,
            object_poses=things,
            scene_poses=places,
            targets=self._path.object_poses[steps],
            contact_forces=np.array(self._forces),
            holding=self._path.holding[steps],
            supported=np.array(self._supported),
            contact_depth=self._depth,
            skin_depth=float(skin_depths(self._scene.hand, hands, field, things).max(initial=0.0)),
            wall_time=wall_time,
            force_times=force_times,
            driven_objects=self._driven,
            goal=goal,
            burst=self._scene.burst,
            set_down=bool((self._path.stages == Stage.RELEASING).any()),
        )
