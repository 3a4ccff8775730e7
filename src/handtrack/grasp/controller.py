"""Control of a grasping hand: joint torques from reference motion and contact forces (III.5).

tau = tau_active + tau_gravity + tau_grasp (Eq. III.19). The servo of Eq. III.20 is solved
implicitly over the time step (stable proportional-derivative control, Tan, Liu and Turk 2011),
since Table III.1's damping is far larger than what an explicit servo can hold on a fingertip of
4 g; its damping acts on the velocity's departure from the reference's, without which the hand lags.
The full controller also lets set points give way where the hand touches (`touch`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

from handtrack.errors import InputError
from handtrack.grasp.contact_forces import ForceConfig, contact_forces
from handtrack.grasp.gains import Gains
from handtrack.grasp.reference import Stage
from handtrack.grasp.touch import SetPoints
from handtrack.grasp.turns import inverse, product, rotation_vector
from handtrack.hand.skeleton import ANGLES, finger_of_bone
from handtrack.physics.contacts import Contacts
from handtrack.physics.scene import Scene

Float = NDArray[np.float64]

Variant = Literal["full", "pd", "pollard-zordan"]

# A thin call: the checks of SciPy's Cholesky solver take longer than the solution.
(_SOLVE_POSITIVE,) = get_lapack_funcs(("posv",), dtype=np.float64)

VARIANTS: tuple[Variant, ...] = ("full", "pd", "pollard-zordan")


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig:
    """Settings of the controller."""

    gains: Gains = field(default_factory=Gains)
    forces: ForceConfig = field(default_factory=ForceConfig)
    force_interval: int = 4
    """Steps between solutions of the contact force program; its forces change slowly."""
    press_per_weight: float = 1.0
    """Least normal force of a planned patch beyond `ForceConfig.least_press`, as a share of the
    object's weight."""
    reach_force: float = 0.4
    """Force with which a finger that should touch and does not is pushed on [N]."""
    grip_time: float = 0.15
    """Time in which contact forces rise once all planned contacts are there [s]."""
    patience: float = 0.15
    """Time after which they rise without waiting for the last contact [s]."""
    touch_force: float = 0.02
    """A bone touches when it presses with at least this [N]."""
    set_point_closing: float = 0.0
    """How much further than the reference the set points of "pollard-zordan" close each finger
    joint while holding [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What the reference wants at one instant."""

    hand: Float
    """qpos of the hand (`HandLayout.qpos`), shape (nhandq,)."""
    hand_velocity: Float
    """Velocity of its degrees of freedom, shape (nhanddof,)."""
    thing: Float
    """Pose of the object, shape (7,)."""
    thing_velocity: Float
    """Linear and angular velocity of the object in the world, shape (6,)."""
    stage: Stage
    """What the hand is at; contact forces are asked for from `TAKING` to `HOLDING`."""


class GraspController:
    """Drives the hand of a scene so that it grasps one of its objects."""

    def __init__(
        self,
        scene: Scene,
        contact_bones: NDArray,
        contact_points: Float,
        contact_normals: Float,
        *,
        index: int = 0,
        variant: Variant = "full",
        config: ControlConfig | None = None,
    ) -> None:
        """Prepare for one grasp.

        Args:
            scene: The simulated world.
            contact_bones: Bone of each planned contact, shape (ncontact,).
            contact_points: Where on the object each should be [m], its frame, shape (ncontact, 3).
            contact_normals: Outward normals of the object there, shape (ncontact, 3).
            index: Which of the scene's objects to grasp.
            variant: "full"; "pd" leaves tau_grasp out; "pollard-zordan" servos as Pollard and
                Zordan 2005 per frame of the reference: set points, gravity compensation of the
                hand, and the held object's weight taken at the wrist, without contact forces.
            config: Settings.

        Raises:
            InputError: `variant` is unknown.
        """
        if variant not in VARIANTS:
            raise InputError(f"variant is {variant!r}; expected one of {', '.join(VARIANTS)}")
        self.scene, self.index, self.variant = scene, index, variant
        self.config = config or ControlConfig()
        self._bones = np.asarray(contact_bones, np.int64)
        self._points = np.asarray(contact_points, np.float64).reshape(-1, 3)
        self._normals = np.asarray(contact_normals, np.float64).reshape(-1, 3)
        self._stiffness, self._damping = self.config.gains.of_hand(scene.layout.bone_dofs())
        self._resistance = scene.config.timestep * self._stiffness + self._damping
        thing = scene.objects[index]
        self._weight = thing.mass * scene.config.gravity
        self._friction = thing.friction
        self._flexions = _flexions(scene)
        self._set_points = SetPoints(scene, self._bones)
        self._calls = 0
        self._waited = 0.0
        self._patches: list[tuple[int, Float, Float]] = []
        self.grip = 0.0
        """How much of the contact forces is applied, 0 to 1."""
        self.force_times: list[float] = []
        """How long each solution for contact forces took [s]."""

    def torques(self, target: Target) -> Float:
        """Generalised forces for the next step, shape (nhanddof,)."""
        scene = self.scene
        gravity = scene.hand_bias()
        way = scene.hand_error(target.hand)
        extra = np.zeros(len(gravity))
        gripping = Stage.TAKING <= target.stage <= Stage.HOLDING
        if self.variant == "full":
            self._give_way(way, target)
            if gripping:
                extra = self._grasp_torque(target)
        elif self.variant == "pollard-zordan" and gripping:
            extra[2] = self._weight if len(scene.contacts(self.index)) else 0.0
            way += self.config.set_point_closing * self._flexions
        self._calls += 1
        return self._servo(way, target.hand_velocity, extra) + gravity + extra

    def _give_way(self, way: Float, target: Target) -> None:
        """Move the set points, and `way` with them, to what the hand has found."""
        points, interval = self._set_points, self.config.force_interval
        if target.stage in (Stage.CLOSING, Stage.TAKING):
            touching = self._touching()
            points.settle(way, target.stage, {finger_of_bone(bone) for bone in touching})
            self._grip_on(target.stage, touching)
        elif target.stage in (Stage.CARRYING, Stage.HOLDING):
            self._grip_on(target.stage, set())
            if self._calls % interval == 0:
                palm, thing = self.scene.hand_pose()[:7], self.scene.object_pose(self.index)
                points.follow(palm, thing, target.hand[:7], target.thing, steps=interval)
        else:
            points.let_go()
            self.grip, self._waited = 0.0, 0.0
        points.shift(way)

    def _touching(self) -> set[int]:
        contacts = self.scene.contacts(self.index)
        press = np.einsum("ni,ni->n", contacts.forces, contacts.normals)
        return {int(bone) for bone in contacts.bones[press > self.config.touch_force]}

    def _grip_on(self, stage: Stage, touching: set[int]) -> None:
        """Let the contact forces rise when all planned contacts are there, or time is up."""
        if stage is Stage.CLOSING:
            return
        dt = self.scene.config.timestep
        self._waited += dt
        ready = touching.issuperset(self._bones.tolist()) or self._waited > self.config.patience
        if ready or self.grip > 0.0:
            self.grip = min(1.0, self.grip + dt / self.config.grip_time)

    def _servo(self, way: Float, velocity: Float, extra: Float) -> Float:
        """tau_active: Eq. III.20 at the end of the step, where the servo itself will have moved."""
        scene = self.scene
        # tau = K_p (way + dt v_goal - dt v') + K_d (v_goal - v'),  v' = v + dt M^-1 (tau + rest)
        pull = self._stiffness * way + self._resistance * (velocity - scene.hand_velocity())
        give = scene.config.timestep * self._resistance
        known = extra + scene.hand_constraint()
        system = scene.hand_inertia()
        diagonal = system.ravel()[:: len(system) + 1]
        diagonal += give
        # Symmetric: transposed it is as LAPACK wants it, and need not be copied.
        _, accel, info = _SOLVE_POSITIVE(system.T, pull + known, overwrite_a=1, overwrite_b=1)
        # Only a state that is not finite has no inertia; `Scene.burst` tells of it.
        return pull - give * accel if info == 0 else np.zeros_like(pull)

    # tau_grasp (Eq. III.21 to III.23)

    def _grasp_torque(self, target: Target) -> Float:
        if self._calls % self.config.force_interval == 0:
            self._solve_forces(target)
        return self.scene.hand_torque(self._patches)

    def _solve_forces(self, target: Target) -> None:
        scene, config = self.scene, self.config
        pose = scene.object_pose(self.index)
        turn = scene.object_rotation(self.index)
        touching = scene.contacts(self.index).patches()
        self._patches = self._reaching_pushes(touching, pose[:3], turn)
        if not len(touching) or self.grip == 0.0:
            return
        wrench = self._virtual_wrench(target, pose, turn)
        wrench[2] += self._weight
        planned = self._pressing(touching.bones)
        least = planned * (config.forces.least_press + config.press_per_weight * self._weight)
        if (touching.normals @ touching.normals.T).min() > -0.3:
            least *= 0.0  # nothing opposes: pressing would only push the object away
        started = time.perf_counter()
        forces, twists = contact_forces(
            touching.points - pose[:3], touching.normals, wrench, friction=self._friction,
            least_press=np.minimum(least, config.forces.most_press), config=config.forces,
        )  # fmt: skip
        self.force_times.append(time.perf_counter() - started)
        wrenches = np.concatenate([forces, twists[:, None] * touching.normals], 1)
        self._patches += [
            (int(bone), point, self.grip * wrench)
            for bone, point, wrench in zip(touching.bones, touching.points, wrenches, strict=True)
        ]

    def _pressing(self, touching: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which touching bones press: the planned ones, and others of a finger whose pad is off."""
        bones, planned = touching.tolist(), set(self._bones.tolist())
        standing_in = {finger_of_bone(bone) for bone in planned.difference(bones)}
        standing_in -= {finger_of_bone(bone) for bone in planned.intersection(bones)}
        return np.array([bone in planned or finger_of_bone(bone) in standing_in for bone in bones])

    def _reaching_pushes(
        self, touching: Contacts, centre: Float, turn: Float
    ) -> list[tuple[int, Float, Float]]:
        """Pushes that bring planned contacts about which do not touch yet, or no more."""
        pushes, there = [], set(touching.bones.tolist())
        for bone, local, outward in zip(self._bones, self._points, self._normals, strict=True):
            if int(bone) not in there:
                wrench = np.zeros(6)
                wrench[:3] = -self.config.reach_force * (turn @ outward)
                pushes.append((int(bone), centre + turn @ local, wrench))
        return pushes

    def _virtual_wrench(self, target: Target, pose: Float, turn: Float) -> Float:
        """f_v and tau_v of Eq. III.22, shape (6,), damping the departure from the reference."""
        gains = self.config.gains
        velocity = self.scene.object_velocity(self.index)
        lag = target.thing_velocity[:3] - velocity[:3]
        spin = target.thing_velocity[3:] - turn @ velocity[3:]
        away = rotation_vector(product(target.thing[3:].tolist(), inverse(pose[3:].tolist())))
        force = gains.object_translation[0] * (target.thing[:3] - pose[:3])
        torque = gains.object_rotation[0] * np.array(away)
        return np.concatenate(
            [force + gains.object_translation[1] * lag, torque + gains.object_rotation[1] * spin]
        )


def _flexions(scene: Scene) -> Float:
    """1 for each degree of freedom that bends a finger, else 0, shape (nhanddof,)."""
    rates = np.concatenate([np.zeros(6), [name.endswith("flexion") for name in ANGLES]])
    pose = scene.hand_pose()
    return scene.layout.velocity(pose, rates)
