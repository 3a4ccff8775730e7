"""Set points that give way where the hand touches: how a plan that errs by millimetres takes hold.

A reference pose is never exact, and a stiff servo turns a millimetre of error into a newton. So a
finger that touches while the hand closes waits for the others, and while the hand takes hold its
set point settles where the finger stands: from then on the servo keeps the grasp as it is, and
presses no more than the contact forces ask for. While the object is carried the palm's set point
follows the object as it lies in the hand, not as it was planned to lie.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from handtrack.grasp.reference import Stage
from handtrack.grasp.turns import inverse, product, rotated, rotation_vector
from handtrack.hand.skeleton import FINGERS, finger_of_bone
from handtrack.physics.scene import Scene

Float = NDArray[np.float64]

YIELD_TIME = 0.015
"""Time in which a touching finger's set point comes to where the finger is [s]."""

LET_GO_TIME = 0.1
"""Time in which set points return to the reference when the hand opens [s]."""

FOLLOW_TIME = 0.25
"""Time in which the palm's set point follows a shift of the object in the hand [s]."""

MOST_SHIFT = 0.03
"""Largest shift of the palm's set point [m]; beyond it the object is as good as lost."""

MOST_TURN = 0.5
"""Largest turn of the palm's set point [rad]."""


class SetPoints:
    """Departures of the servo's set points from the reference."""

    def __init__(self, scene: Scene, bones: NDArray[np.int64]) -> None:
        """Start without any.

        Args:
            scene: The simulated world.
            bones: Bones of the planned contacts.
        """
        self._scene = scene
        self._dof_fingers = np.array([finger_of_bone(b) for b in scene.layout.bone_dofs()])
        self._planned = {finger_of_bone(int(bone)) for bone in bones}
        self.offset = np.zeros(scene.layout.nv)
        """Added to the way from the hand to the reference, shape (nhanddof,)."""
        self._shift = np.zeros(3)
        self._turn = np.zeros(3)

    def settle(self, way: Float, stage: Stage, touching: set[int]) -> None:
        """Let fingers give way.

        Args:
            way: From the hand to the reference, shape (nhanddof,).
            stage: What the hand is at.
            touching: Fingers that touch the object.
        """
        dt = self._scene.config.timestep
        giving = touching | self._planned if stage is Stage.TAKING else touching
        gives = np.zeros(len(FINGERS) + 1, bool)  # last the palm, which never does
        gives[[finger for finger in giving if finger >= 0]] = True
        chosen = gives[self._dof_fingers]
        self.offset[chosen] -= (dt / YIELD_TIME) * (way + self.offset)[chosen]

    def let_go(self) -> None:
        """Let the set points return to the reference."""
        keep = 1.0 - self._scene.config.timestep / LET_GO_TIME
        self.offset *= keep
        self._shift *= keep
        self._turn *= keep

    def follow(
        self, palm: Float, thing: Float, palm_goal: Float, thing_goal: Float, *, steps: int
    ) -> None:
        """Let the palm's set point follow the object as it lies in the hand.

        Args:
            palm: Place and orientation of the palm, shape (7,), world.
            thing: The object's, shape (7,).
            palm_goal: What the reference has for the palm, shape (7,).
            thing_goal: What it has for the object, shape (7,).
            steps: Time steps since the last call.
        """
        share = steps * self._scene.config.timestep / FOLLOW_TIME
        hand, lies, wanted, goal = (
            pose[3:].tolist() for pose in (palm, thing, palm_goal, thing_goal)
        )
        # Where the palm must be for the object, lying as it does, to be at its goal.
        swing = product(goal, inverse(lies))
        place = thing_goal[:3] + rotated(swing, (palm[:3] - thing[:3]).tolist())
        turn = rotation_vector(product(product(swing, hand), inverse(wanted)))
        self._shift += share * (place - palm_goal[:3] - self._shift)
        self._turn += share * (turn - self._turn)
        for value, most in ((self._shift, MOST_SHIFT), (self._turn, MOST_TURN)):
            value *= min(1.0, most / max(math.hypot(*value), 1e-12))

    def shift(self, way: Float) -> None:
        """Add the departures to the way from the hand to the reference, shape (nhanddof,)."""
        way += self.offset
        way[:3] += self._shift
        # The palm's own frame is that of its three rotational degrees of freedom.
        way[3:6] += self._turn @ self._scene.bone_frame(0)[0]
