"""Whether a recording holds under physics: played back as it is, contact forces and all."""

from __future__ import annotations

import numpy as np

from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.recording import GraspRecording
from handtrack.grasp.run import Goal
from handtrack.grasp.simulation import SimulationConfig, simulate
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.physics.bone_solids import BoneSolid

GOAL = Goal(lift=0.0, carry=0.0, hold=0.5)
"""A recording goes where it goes; the object must stay in the hand on the way and at its end."""


def holds(
    recording: GraspRecording,
    thing: RigidObject,
    *,
    hand: ShapedHand,
    distances: DistanceField,
    solids: tuple[BoneSolid, ...],
) -> bool:
    """Whether the hand brings the object where the recording has it (`grasp.simulation`).

    Args:
        recording: Hand and object about the object's centre of mass at rest.
        thing: The object.
        hand: The hand.
        distances: Signed distances of the object.
        solids: `bone_solids` of the hand.
    """
    up = np.array([0.0, 0.0, thing.rest_height])
    hands, things = recording.hand_poses.copy(), recording.object_poses.copy()
    hands[:, :3] += up
    things[:, :3] += up
    plan = GraspPlan(
        grip=recording.grip,
        times=np.arange(len(hands)) / recording.frame_rate,
        hand_poses=hands,
        object_poses=things,
        phases=recording.phases,
        contact_bones=recording.contact_bones,
        contact_local=recording.contact_local,
        contact_points=recording.contact_points,
        contact_normals=recording.contact_normals,
        feasible=True,
    )
    config = SimulationConfig(goal=GOAL)
    return simulate(
        plan, thing, hand=hand, distances=distances, solids=solids, config=config
    ).success
