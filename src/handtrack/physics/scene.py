"""A hand, objects and a table under physics: a MuJoCo model, its state and what can be asked of it.

World frame: z up, the table's top is the plane z = 0. Only the hand is ever driven: `apply` takes
generalised forces of the hand's own degrees of freedom, and objects move by contact alone.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NBONE
from handtrack.objects.rigid_object import RigidObject
from handtrack.optional import import_extra
from handtrack.physics.bone_solids import BoneSolid, bone_solids
from handtrack.physics.contacts import Contacts
from handtrack.physics.hand_body import Layout, add_hand, check_layout
from handtrack.physics.layout import HandLayout
from handtrack.physics.object_body import add_object, add_table

Float = NDArray[np.float64]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Settings of the simulation."""

    timestep: float = 0.001
    """Time of one step [s] (thesis III.7)."""
    gravity: float = 9.81
    """Fall acceleration [m/s^2]."""
    contact_time: float = 0.004
    """Time constant of a contact's recovery [s]: skin is soft. At least two time steps."""
    contact_stiffness: tuple[float, float, float] = (0.9, 0.99, 0.001)
    """MuJoCo's solimp: share of a constraint's force at touch, when deep, and over what depth
    [m]."""
    torsional_friction: float = 0.005
    """Radius over which a patch resists twisting [m]: two thirds of a pad's contact radius."""
    rolling_friction: float = 0.0005
    """Radius of resistance to rolling [m]; used with `contact_dims` 6."""
    contact_dims: int = 4
    """MuJoCo's condim: 3 slides, 4 twists as well (soft finger), 6 rolls as well."""
    friction_stiffness: float = 100.0
    """MuJoCo's impratio: how much stiffer friction is than the normal force. With 10 a held
    thing creeps out of the hand by centimetres in two seconds."""
    armature: float = 2e-5
    """Inertia added to each finger joint [kg m^2]: flesh and tendons that move along."""
    ccd_iterations: int = 50
    """Limit of the convex collision search."""

    def __post_init__(self) -> None:
        if not 0.0 < self.timestep <= 0.01:
            raise InputError(f"timestep is {self.timestep}; expected more than 0, at most 0.01 s")
        if self.contact_time < 2.0 * self.timestep:
            raise InputError(
                f"contact_time is {self.contact_time}; expected at least two time steps, "
                f"{2 * self.timestep} s"
            )
        if self.contact_dims not in (3, 4, 6):
            raise InputError(f"contact_dims is {self.contact_dims}; expected 3, 4 or 6")
        for name in ("torsional_friction", "rolling_friction", "armature"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} is {getattr(self, name)}; expected at least 0")


_ROWS = np.arange(4)
_BONE, _OBJECT = 1, 2


@dataclass(slots=True)
class _Touching:
    """Contacts of the last step as MuJoCo gave them; copied, since the next stage rebuilds them."""

    geoms: NDArray[np.int32]
    points: Float
    frames: Float
    distances: Float
    rows: NDArray[np.int32]
    """First of each contact's rows in `forces`; negative where it is too far to count."""
    forces: Float


class Scene:
    """One simulated world with one hand in it."""

    def __init__(
        self,
        hand: ShapedHand,
        objects: Sequence[RigidObject] = (),
        *,
        layout: Layout = "tracking",
        table: bool = True,
        solids: tuple[BoneSolid, ...] | None = None,
        config: SceneConfig | None = None,
    ) -> None:
        """Build the model; the hand stands open at the origin, objects rest on the table.

        Args:
            hand: One person's hand.
            objects: What else is there.
            layout: Joint layout of the hand.
            table: Whether there is a table; without one objects fall for ever.
            solids: `bone_solids` of the hand, for many scenes with one hand; made when absent.
            config: Settings.

        Raises:
            MissingDependencyError: MuJoCo is not installed.
        """
        mujoco = import_extra("mujoco", "physics", "simulating the hand")
        if mujoco.get_mju_user_warning() is None:
            # Its own way is a file MUJOCO_LOG.TXT in the working folder.
            mujoco.set_mju_user_warning(_LOG.warning)
        self.config = config or SceneConfig()
        self.hand = hand
        self.objects = tuple(objects)
        self.layout = HandLayout(hand, check_layout(layout))
        self._mujoco = mujoco
        self._spec = self._build(layout, table, solids or bone_solids(hand))
        self.model = self._spec.compile()
        self.data = mujoco.MjData(self.model)
        self.hand_dofs = np.arange(self.layout.nv)
        """Degrees of freedom of the hand in the model, shape (nhanddof,)."""
        self._hand_q = slice(0, self.layout.nq)
        geom_body = np.array(self.model.geom_bodyid)
        first = 1 + NBONE
        # Geom -> bone, geom -> object; -1 where it is neither.
        self._geom_bone = np.where((geom_body >= 1) & (geom_body < first), geom_body - 1, -1)
        self._geom_object = np.where(geom_body >= first, geom_body - first, -1)
        # For each object, what its contacts with the hand are between.
        self._geom_kinds = [
            _BONE * (self._geom_bone >= 0) + _OBJECT * (self._geom_object == k)
            for k in range(len(self.objects))
        ]
        self._mass = np.zeros((self.model.nv, self.model.nv))
        self.reset()

    def _build(self, layout: Layout, table: bool, solids: tuple[BoneSolid, ...]) -> Any:
        mujoco, config = self._mujoco, self.config
        spec = mujoco.MjSpec()
        spec.modelname = "handtrack"
        spec.compiler.degree = False
        option = spec.option
        option.timestep, option.gravity = config.timestep, (0.0, 0.0, -config.gravity)
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = config.friction_stiffness
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.ccd_iterations = config.ccd_iterations
        contact = {
            "solref": (config.contact_time, 1.0),
            "solimp": (*config.contact_stiffness, 0.5, 2.0),
            "condim": config.contact_dims,
        }
        twist = (config.torsional_friction, config.rolling_friction)
        add_hand(
            spec, self.hand, solids, layout=layout, armature=config.armature,
            friction=(1.0, *twist), contact=contact,
        )  # fmt: skip
        for k, thing in enumerate(self.objects):
            add_object(spec, thing, name=f"object_{k}", twist=twist, contact=contact)
        if table:
            add_table(spec, contact=contact)
        return spec

    def reset(self) -> None:
        """Back to the start: the hand open and still, objects at rest at the origin."""
        self._mujoco.mj_resetData(self.model, self.data)
        pose = np.zeros(28)
        pose[3], pose[7:] = 1.0, self.hand.rest_angles
        self.data.qpos[self._hand_q] = self.layout.qpos(pose)
        for k, thing in enumerate(self.objects):
            self.data.qpos[self._object_q(k)] = (0, 0, thing.rest_height, 1, 0, 0, 0)
        self._look()

    def _look(self) -> None:
        """Bring everything that follows from the state up to date."""
        self._mujoco.mj_forward(self.model, self.data)
        self._note_contacts()
        self._mujoco.mj_step1(self.model, self.data)

    def save(self, path: str | Path) -> None:
        """Write the model as MJCF, one file that MuJoCo's viewer opens; key "now" is the state."""
        spec = self._spec.copy()
        spec.add_key(name="now", qpos=self.data.qpos.copy(), qvel=self.data.qvel.copy())
        spec.compile()
        Path(path).write_text(spec.to_xml(), "utf-8")

    # State

    def _object_q(self, index: int) -> slice:
        if not 0 <= index < len(self.objects):
            raise InputError(f"there is no object {index}; this scene has {len(self.objects)}")
        start = self.layout.nq + 7 * index
        return slice(start, start + 7)

    def _object_v(self, index: int) -> slice:
        start = self.layout.nv + 6 * index
        return slice(start, start + 6)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.data.time)

    def set_hand(self, pose: ArrayLike, velocity: ArrayLike | None = None) -> None:
        """Put the hand somewhere.

        Args:
            pose: Pose in the world, shape (28,).
            velocity: Velocity of its degrees of freedom, shape (nhanddof,); None: at rest.
        """
        pose = np.asarray(pose, np.float64)
        if pose.shape != (28,) or not np.isfinite(pose).all():
            raise InputError(f"pose has shape {pose.shape}; expected 28 finite numbers")
        self.data.qpos[self._hand_q] = self.layout.qpos(pose)
        self.data.qvel[self.hand_dofs] = 0.0 if velocity is None else velocity
        self._look()

    def set_object(self, index: int, pose: ArrayLike, velocity: ArrayLike | None = None) -> None:
        """Put an object somewhere.

        Args:
            index: Which object.
            pose: Centre of mass [m] and quaternion in the world, shape (7,).
            velocity: Linear [m/s] in the world, angular [rad/s] in its own frame, shape (6,).
        """
        pose = np.asarray(pose, np.float64)
        if pose.shape != (7,) or not np.isfinite(pose).all():
            raise InputError(f"object pose has shape {pose.shape}; expected 7 finite numbers")
        self.data.qpos[self._object_q(index)] = pose
        self.data.qvel[self._object_v(index)] = 0.0 if velocity is None else velocity
        self._look()

    def hand_pose(self) -> Float:
        """Pose of the hand in the world, shape (28,)."""
        return self.layout.pose(self.data.qpos[self._hand_q])

    def hand_velocity(self) -> Float:
        """Velocity of the hand's degrees of freedom [m/s, rad/s], shape (nhanddof,)."""
        return self.data.qvel[: self.layout.nv].copy()

    def object_pose(self, index: int) -> Float:
        """Centre of mass [m] and quaternion of an object in the world, shape (7,)."""
        return self.data.qpos[self._object_q(index)].copy()

    def object_velocity(self, index: int) -> Float:
        """Linear [m/s] in the world, angular [rad/s] in the object's frame, shape (6,)."""
        return self.data.qvel[self._object_v(index)].copy()

    # Dynamics of the hand (Eq. III.18)

    def hand_error(self, target: ArrayLike) -> Float:
        """Way from the hand's coordinates to others, shape (nhanddof,).

        Args:
            target: qpos of the hand (`layout.qpos` of a pose), shape (nhandq,).
        """
        goal = self.data.qpos.copy()
        goal[self._hand_q] = target
        way = np.empty(self.model.nv)
        self._mujoco.mj_differentiatePos(self.model, way, 1.0, self.data.qpos, goal)
        return way[: self.layout.nv]

    def hand_inertia(self) -> Float:
        """M(q) of the hand, shape (nhanddof, nhanddof)."""
        self._mujoco.mj_fullM(self.model, self.data, self._mass)
        return self._mass[: self.layout.nv, : self.layout.nv].copy()

    def hand_bias(self) -> Float:
        """C(q, q') + h(q) of the hand: Coriolis, centrifugal and gravity, shape (nhanddof,)."""
        return self.data.qfrc_bias[: self.layout.nv].copy()

    def hand_constraint(self) -> Float:
        """Generalised force of contacts and joint limits in the last step, shape (nhanddof,)."""
        return self._constraint

    def hand_torque(self, wrenches: Iterable[tuple[int, Float, Float]]) -> Float:
        """J^T f: what forces on the bones are for the hand's joints, shape (nhanddof,).

        Args:
            wrenches: Of each the bone, the point in the world where it acts [m], shape (3,), and
                force [N] and torque [N m] there, shape (6,).
        """
        total = np.zeros(self.model.nv)
        for bone, point, wrench in wrenches:
            self._mujoco.mj_applyFT(
                self.model, self.data, wrench[:3], wrench[3:], point, bone + 1, total
            )
        return total[: self.layout.nv]

    def object_rotation(self, index: int) -> Float:
        """Rotation R_world_object, shape (3, 3), of an object."""
        return self.data.xmat[1 + NBONE + index].reshape(3, 3).copy()

    def bone_frame(self, bone: int) -> tuple[Float, Float]:
        """Rotation R_world_bone, shape (3, 3), and origin [m], shape (3,), of a bone."""
        return self.data.xmat[bone + 1].reshape(3, 3).copy(), self.data.xpos[bone + 1].copy()

    def apply(self, forces: ArrayLike) -> None:
        """Drive the hand until told otherwise.

        Args:
            forces: Generalised forces of the hand's degrees of freedom [N, N m], (nhanddof,).
        """
        self.data.qfrc_applied[self.hand_dofs] = forces

    def step(self) -> None:
        """Go one time step on."""
        self._mujoco.mj_step2(self.model, self.data)
        self._note_contacts()
        self._mujoco.mj_step1(self.model, self.data)

    # Contacts

    def _note_contacts(self) -> None:
        data = self.data
        contact = data.contact
        self._touching = _Touching(
            contact.geom.copy(),
            contact.pos.copy(),
            contact.frame.copy(),
            contact.dist.copy(),
            contact.efc_address.copy(),
            data.efc_force.copy(),
        )
        self._chosen: dict[int, tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._known: dict[int, Contacts] = {}
        self._constraint = data.qfrc_constraint[: self.layout.nv].copy()

    def _pairs(self, index: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Contacts of the hand with an object: which, and which of the two geoms is the object."""
        if index not in self._chosen:
            seen = self._touching
            kinds = self._geom_kinds[index][seen.geoms]
            ours = (kinds[:, 0] + kinds[:, 1] == _BONE + _OBJECT) & (seen.rows >= 0)
            chosen = ours.nonzero()[0]
            self._chosen[index] = chosen, kinds[chosen, 1] // _OBJECT
        return self._chosen[index]

    def contact_depth(self, index: int) -> float:
        """Deepest overlap of the hand with an object in the last step [m]; -inf without contact."""
        chosen, _ = self._pairs(index)
        return -float(self._touching.distances[chosen].min()) if len(chosen) else -np.inf

    def contacts(self, index: int) -> Contacts:
        """Contacts of the hand with an object in the last step."""
        if index not in self._known:
            self._known[index] = self._contacts(index)
        return self._known[index]

    def _contacts(self, index: int) -> Contacts:
        seen = self._touching
        chosen, side = self._pairs(index)
        # Frames and forces point from the first geom to the second.
        frames = seen.frames[chosen].reshape(-1, 3, 3) * (2.0 * side - 1.0)[:, None, None]
        forces = np.zeros((len(chosen), 4))
        if len(chosen):
            # Without torsion there is no fourth row, and after the last contact nothing at all.
            rows = seen.rows[chosen, None] + _ROWS[: self.config.contact_dims]
            forces[:, : rows.shape[1]] = seen.forces[rows]
        return Contacts(
            bones=self._geom_bone[seen.geoms[chosen, 1 - side]],
            points=seen.points[chosen],
            normals=frames[:, 0],
            depths=-seen.distances[chosen],
            forces=np.matmul(forces[:, None, :3], frames)[:, 0],
            torsions=forces[:, 3],
        )

    def supported(self, index: int, *, besides: Sequence[int] = ()) -> bool:
        """Whether an object touched anything but the hand in the last step.

        Args:
            index: Which object.
            besides: Objects that do not count.
        """
        seen = self._touching
        geoms = seen.geoms[seen.rows >= 0]
        things, bones = self._geom_object[geoms], self._geom_bone[geoms]
        mine = (things == index).any(1) & ~np.isin(things, besides).any(1)
        return bool((mine & (bones < 0).all(1)).any())

    def objects_driven(self) -> bool:
        """Whether anything but contact, gravity and the hand's own forces is at work: never."""
        model, data = self.model, self.data
        return bool(
            model.neq or data.xfrc_applied.any() or data.qfrc_applied[self.layout.nv :].any()
        )

    @property
    def burst(self) -> bool:
        """Whether the simulation became unstable at some time; MuJoCo then starts afresh."""
        kinds = self._mujoco.mjtWarning
        bad = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
        return any(self.data.warning[int(kind)].number > 0 for kind in bad)
