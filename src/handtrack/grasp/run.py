"""What a simulated grasp did, and whether it was a success."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.transforms import matrix_to_rotvec, quat_to_matrix

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """When a grasp is a success."""

    lift: float = 0.10
    """The object rises at least this far [m]."""
    carry: float = 0.20
    """It is brought at least this far [m]."""
    hold: float = 2.0
    """It is held at the target this long [s]."""
    position: float = 0.02
    """It stays this near to the target while held [m]."""
    rotation: float = float(np.deg2rad(15.0))
    """Its orientation stays this near to the target's while held [rad]."""
    penetration: float = 0.003
    """The hand enters it this deep at most [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspRun:
    """One simulated grasp. World frame, one entry per recorded step."""

    times: Float
    """Simulated time [s], shape (n,)."""
    hand_poses: Float
    """Hand, shape (n, 28)."""
    object_poses: Float
    """Object, shape (n, 7)."""
    scene_poses: Float
    """Every object of the scene in its order, that one and balls among them, (n, nobject, 7)."""
    targets: Float
    """Where the reference has the object, shape (n, 7)."""
    contact_forces: Float
    """Normal force of each bone on the object [N], shape (n, 16)."""
    holding: NDArray[np.bool_]
    """Whether the object is to be held still at the target, shape (n,)."""
    supported: NDArray[np.bool_]
    """Whether anything but the hand touches the object, shape (n,)."""
    contact_depth: float
    """Deepest overlap of the solids of hand and object [m]."""
    skin_depth: float
    """Deepest place of the skin inside the object [m]; NaN where it was not measured."""
    wall_time: float
    """Time that simulation and control took [s]."""
    force_times: Float
    """How long each solution for contact forces took [s], shape (nsolution,)."""
    driven_objects: bool
    """Whether anything but contact and gravity acted on an object: must be False."""
    goal: Goal
    """What was asked for."""
    burst: bool = False
    """Whether the simulation became unstable."""
    set_down: bool = False
    """Whether the object is brought to where it stands on something, and let go there."""

    @property
    def penetration(self) -> float:
        """The deeper of skin and solids [m]."""
        return float(np.nanmax([self.contact_depth, self.skin_depth]))

    @property
    def lift(self) -> float:
        """How far the object rose at most [m]."""
        return float((self.object_poses[:, 2] - self.object_poses[0, 2]).max())

    @property
    def carry(self) -> float:
        """How far from its start it was when held [m]."""
        held = self.object_poses[self.holding]
        if not len(held):
            return 0.0
        return float(np.linalg.norm(held[:, :3] - self.object_poses[0, :3], axis=1).min())

    def _errors(self) -> tuple[Float, Float]:
        poses, goals = self.object_poses[self.holding], self.targets[self.holding]
        away = np.linalg.norm(poses[:, :3] - goals[:, :3], axis=1)
        turn = quat_to_matrix(poses[:, 3:]) @ np.swapaxes(quat_to_matrix(goals[:, 3:]), 1, 2)
        return away, np.linalg.norm(matrix_to_rotvec(turn), axis=1)

    @property
    def position_error(self) -> float:
        """Distance from the target at the end of the hold [m]; infinite without a hold."""
        away, _ = self._errors()
        return float(away[-1]) if len(away) else np.inf

    @property
    def rotation_error(self) -> float:
        """Angle from the target's orientation at the end of the hold [rad]."""
        _, turn = self._errors()
        return float(turn[-1]) if len(turn) else np.inf

    @property
    def held(self) -> bool:
        """Whether the hand kept it near the target for the whole hold; alone, if not set down."""
        away, turn = self._errors()
        if len(away) < 2:
            return False
        times = self.times[self.holding]
        step = (times[-1] - times[0]) / (len(times) - 1)
        alone = self.set_down or not self.supported[self.holding].any()
        near = (away <= self.goal.position).all() and (turn <= self.goal.rotation).all()
        touched = bool((self.contact_forces[self.holding].sum(1) > 0.0).all())
        lasted = times[-1] - times[0] + step >= self.goal.hold - 1e-6
        return bool(alone and near and touched and lasted)

    @property
    def placed_error(self) -> float:
        """Distance from the target when all is over, the hand having let go if it was to [m]."""
        return float(np.linalg.norm(self.object_poses[-1, :3] - self.targets[-1, :3]))

    @property
    def success(self) -> bool:
        """Lifted, carried, held near the target and never entered too deep."""
        return self.failure is None

    @property
    def realtime_factor(self) -> float:
        """Simulated time by the time that it took: above one is faster than real time."""
        return float(self.times[-1] - self.times[0]) / max(self.wall_time, 1e-9)

    @property
    def failure(self) -> str | None:
        """The first thing that went wrong; None for a success."""
        away, turn = self._errors()
        checks = (
            (not self.burst, "the simulation became unstable"),
            (not self.driven_objects, "something else than the hand drove an object"),
            (self.lift >= self.goal.lift, f"lifted {1000 * self.lift:.0f} mm"),
            (self.carry >= self.goal.carry, f"carried {1000 * self.carry:.0f} mm"),
            (
                bool(len(away)) and away.max() <= self.goal.position,
                f"{1000 * away.max(initial=0.0):.0f} mm from the target",
            ),
            (
                bool(len(turn)) and turn.max() <= self.goal.rotation,
                f"{np.rad2deg(turn.max(initial=0.0)):.0f} degrees from the target",
            ),
            (self.held, "not held by the hand alone for the whole time"),
            (
                self.penetration <= self.goal.penetration,
                f"entered by {1000 * self.penetration:.1f} mm",
            ),
        )
        return next((text for passed, text in checks if not passed), None)
