"""Several grasps one after the other with one hand, such as blocks that are stacked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.grasp.obstacles import Obstacle
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.recording import FRAME_RATE
from handtrack.grasp.synthesis import GraspSynthesizer
from handtrack.grasp.trajectory import reach
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject

Float = NDArray[np.float64]

OVER = 0.12
"""How high the hand rises on its way from one object to the next [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """One object brought to another place."""

    index: int
    """Which object."""
    target: ArrayLike
    """Where to bring it: centre of mass [m] and quaternion, shape (7,)."""
    grip: str = "auto"
    """Grip mode; "auto" chooses."""
    seed: int = 0
    """Seed of the search."""


def plan_sequence(
    planner: GraspSynthesizer,
    things: Sequence[RigidObject],
    starts: ArrayLike,
    moves: Sequence[Move],
    *,
    end: ArrayLike | None = None,
    distances: Sequence[DistanceField] | None = None,
) -> list[tuple[int, GraspPlan]]:
    """Plan moves one after the other, for `grasp.simulation.simulate_sequence`.

    The hand comes to every object from the same side. Where it takes one and where it sets it down
    it keeps clear of the others; on its way it does not look at them.

    Args:
        planner: Makes each plan; `SynthesisConfig(release=True)` lets go of every object.
        things: The objects.
        starts: Where they stand at first, shape (nobject, 7).
        moves: What to do; an object may be moved again from where it was brought.
        end: Where the hand goes when all is done, shape (28,); without, it stays where it let go.
        distances: Signed distances of every object; measured when absent.

    Returns:
        Which object each plan grasps, and the plan.

    Raises:
        InputError: Shapes do not fit, there is no such object, or a move cannot be done; the
            message says which and why.
    """
    places = np.array(starts, np.float64)
    if places.shape != (len(things), 7):
        raise InputError(f"starts have shape {places.shape}; expected ({len(things)}, 7)")
    if distances is not None and len(distances) != len(things):
        raise InputError(f"there are {len(distances)} distance fields for {len(things)} objects")
    if distances is None:
        distances = [DistanceField.of(thing, device=planner.device) for thing in things]
    plans: list[tuple[int, GraspPlan]] = []
    for number, move in enumerate(moves):
        k = move.index
        if not 0 <= k < len(things):
            raise InputError(f"move {number} is of object {k}; there are {len(things)}")
        try:
            plan = planner.plan(
                things[k], grip=move.grip, start=waiting_pose(planner, places[k]),
                place=places[k], target=move.target, seed=move.seed,
                obstacles=others(distances, places, k), distances=distances[k],
            )  # fmt: skip
        except InputError as error:
            raise InputError(f"move {number}: {error}") from error
        plans.append((k, plan))
        places[k] = plan.object_poses[-1]
    return joined(planner, plans, end=end)


def others(distances: Sequence[DistanceField], places: Float, index: int) -> list[Obstacle]:
    """All objects but one as obstacles.

    Args:
        distances: Signed distances of every object.
        places: Where they are, shape (nobject, 7).
        index: The one.
    """
    return [
        Obstacle(distances=field, place=place)
        for k, (field, place) in enumerate(zip(distances, places, strict=True))
        if k != index
    ]


def waiting_pose(planner: GraspSynthesizer, place: ArrayLike) -> Float:
    """The hand before it reaches for an object, as one recording has it, shape (28,).

    Args:
        planner: Whose recordings and hand they are.
        place: The object, shape (7,).
    """
    pose = planner.database.recordings[0].hand_poses[0].copy()
    if planner.hand.side == "left":
        pose = mirror_pose(pose)
    pose[:3] += np.asarray(place, np.float64)[:3]
    return pose


def joined(
    planner: GraspSynthesizer,
    plans: Sequence[tuple[int, GraspPlan]],
    *,
    end: ArrayLike | None = None,
) -> list[tuple[int, GraspPlan]]:
    """Plans after each of which the hand goes to where the next one starts.

    Args:
        planner: Whose recordings and hand they are.
        plans: Which object each plan grasps, and the plan.
        end: Where the hand goes after the last one, shape (28,).

    Raises:
        InputError: `end` is no pose.
    """
    starts: list[Float | None] = [plan.hand_poses[0] for _, plan in plans[1:]]
    last = None if end is None else np.asarray(end, np.float64)
    if last is not None and (last.shape != (28,) or not np.isfinite(last).all()):
        raise InputError(f"end has shape {last.shape}; expected 28 finite numbers")
    return [
        (index, plan if goal is None else _going_to(planner, plan, goal))
        for (index, plan), goal in zip(plans, [*starts, last][: len(plans)], strict=True)
    ]


def _going_to(planner: GraspSynthesizer, plan: GraspPlan, pose: Float) -> GraspPlan:
    """A plan after which the hand goes to a pose."""
    last = plan.hand_poses[-1]
    left = planner.hand.side == "left"
    if left:  # recordings are of right hands
        last, pose = mirror_pose(last), mirror_pose(pose)
    way = reach(planner.database, plan.grip, last, np.stack([pose, pose]), FRAME_RATE)
    if left:
        way = mirror_pose(way)
    # Up and over what stands there.
    share = np.linspace(0.0, 1.0, len(way))
    way[:, 2] += OVER * 16.0 * share**2 * (1.0 - share) ** 2
    more = len(way) - 1
    return replace(
        plan,
        times=np.concatenate([plan.times, plan.times[-1] + np.arange(1, more + 1) / FRAME_RATE]),
        hand_poses=np.concatenate([plan.hand_poses, way[1:]]),
        object_poses=np.concatenate([plan.object_poses, np.tile(plan.object_poses[-1], (more, 1))]),
        phases=np.concatenate([plan.phases, np.full(more, "releasing")]),
    )
