"""One trial after the other: placed, fitted, moved, checked."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from grasp_builder.fitting import TABLE_CLEARANCE, GraspFit
from grasp_builder.moving import (
    closing_motion,
    draw_timing,
    reaching_motion,
    releasing_motion,
    transport,
)
from grasp_builder.placing import MANNERS, Placing, draw_placing
from grasp_builder.proving import holds
from handtrack.grasp.feasibility import feasible
from handtrack.grasp.recording import FRAME_RATE, GraspRecording, grasp_yaw, turned_poses
from handtrack.grasp.taxonomy import grip_mode, grip_pads
from handtrack.grasp.trajectory import carried
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.objects.rigid_object import RigidObject
from handtrack.physics.bone_solids import BoneSolid, bone_solids
from handtrack.transforms import quat_to_matrix

Float = NDArray[np.float64]

FRAME_STEP = 5
"""Of so many frames one is tested for what the hand enters; a hand moves 10 mm meanwhile."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildConfig:
    """What a trial must pass, and how often it is tried."""

    trials: int = 4
    """Trials of each grip mode and object that suits it."""
    tries: int = 6
    """Placings that are tried for each trial."""
    most_depth: float = 0.0018
    """Deepest skin in the object in any frame [m]."""
    most_gap: float = 0.0020
    """Farthest fingertip pad from the surface in the grasp [m]."""
    palm_gap: float = 0.004
    """Farthest palm that still counts as a contact [m]."""
    friction_share: float = 0.6
    """Share of the friction that the feasibility test may use."""
    seed: int = 20
    """Seed of all trials."""


@dataclass(slots=True)
class BuildLog:
    """What came of the trials."""

    kept: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    depths: list[float] = field(default_factory=list)


class Builder:
    """Makes recordings of one grip mode and one object."""

    def __init__(
        self, hand: ShapedHand, grip: str, thing: RigidObject, distances: DistanceField,
        solids: tuple[BoneSolid, ...], config: BuildConfig, log: BuildLog,
    ) -> None:  # fmt: skip
        """Prepare the fit."""
        self.hand, self.mode, self.thing = hand, grip_mode(grip), thing
        self.distances, self.solids = distances, solids
        self.config, self.log = config, log
        self._fit = GraspFit(hand, self.mode, grip_pads(hand, grip), distances, -thing.rest_height)

    def recordings(self) -> list[GraspRecording]:
        """The trials that pass."""
        kept: list[GraspRecording] = []
        for trial in range(self.config.trials * MANNERS[self.mode.name].trials):
            for number in range(self.config.tries):
                name = f"{self.mode.name} {self.thing.name}".encode()
                rng = np.random.default_rng([self.config.seed, trial, number, *name])
                made = self._trial(trial, rng)
                if isinstance(made, GraspRecording):
                    kept.append(made)
                    self.log.kept[self.mode.name] += 1
                    break
                self.log.refused[made] += 1
        return kept

    def _trial(self, trial: int, rng: np.random.Generator) -> GraspRecording | str:
        """One recording, or why there is none."""
        placing = draw_placing(MANNERS[self.mode.name], self.thing, rng)
        grasp = self._fit.fit(placing, self._fit.start(placing))
        contacts = self._contacts(placing, grasp)
        if isinstance(contacts, str):
            return contacts
        releases = trial % 2 == 1
        timing = draw_timing(rng, releases=releases)
        closing = closing_motion(
            self.hand, self.mode, placing, grasp, timing,
            aperture=rng.uniform(0.8, 1.3), way=rng.uniform(0.006, 0.016),
        )  # fmt: skip
        reaching = reaching_motion(self.hand, self.mode, closing[0], timing, rng)
        half = 0.5 * placing.yaw
        rest = np.array([0.0, 0.0, 0.0, np.cos(half), 0.0, 0.0, np.sin(half)])
        path = transport(rest, timing, rng, lands=releases)
        manipulation = carried(grasp, path)
        parts = [reaching[:-1], closing, manipulation[1:]]
        things = [np.repeat(rest[None], len(reaching) - 1 + len(closing), axis=0), path[1:]]
        names = ["reaching", "closing", "manipulation"]
        if releases:
            parts.append(releasing_motion(closing, manipulation[-1], timing)[1:])
            things.append(np.repeat(path[-1:], len(parts[-1]), axis=0))
            names.append("releasing")
        poses, objects = np.concatenate(parts), np.concatenate(things)
        depth, reason = self._overlap(placing, poses, objects)
        if reason:
            return reason
        yaw = -grasp_yaw(grasp, np.zeros(3))
        made = GraspRecording(
            grip=self.mode.name, object=self.thing.name, trial=trial, provenance="computed",
            frame_rate=FRAME_RATE, hand_poses=turned_poses(poses, yaw),
            object_poses=turned_poses(objects, yaw),
            phases=np.repeat(names, [len(part) for part in parts]), **contacts,
        )  # fmt: skip
        if not holds(
            made, self.thing, hand=self.hand, distances=self.distances, solids=self.solids
        ):
            return "it does not hold under physics"
        self.log.depths.append(depth)
        return made

    def _contacts(self, placing: Placing, grasp: Float) -> dict[str, NDArray] | str:
        """Contacts of a grasp, or why it will not do."""
        fit, pads = self._fit, self._fit.pads
        places = fit.places(grasp)
        gaps = fit.distance(placing, places)
        tips = np.array(["palm" not in pad.bone for pad in self.mode.pads])
        if np.abs(gaps[tips]).max() > self.config.most_gap:
            return "a fingertip does not touch"
        touching = np.where(tips, True, gaps < self.config.palm_gap)
        points = (places - gaps[:, None] * fit.normal(placing, places)) @ placing.turn
        normals = fit.normal(placing, places) @ placing.turn
        test = feasible(
            points[touching], normals[touching], mass=self.thing.mass,
            friction=self.config.friction_share * self.thing.friction,
        )  # fmt: skip
        if not test.feasible:
            return "it could not carry the object"
        return {
            "contact_bones": pads.bones[touching], "contact_local": pads.points[touching],
            "contact_points": points[touching], "contact_normals": normals[touching],
        }  # fmt: skip

    def _overlap(self, placing: Placing, poses: Float, things: Float) -> tuple[float, str]:
        """Deepest skin in the object [m], and what it hits too deep, if anything."""
        deepest = 0.0
        free = ~self.hand.stub_vertices
        for pose, thing in zip(poses[::FRAME_STEP], things[::FRAME_STEP], strict=True):
            points = skin(self.hand, pose)
            if points[free, 2].min() < -self.thing.rest_height + 0.3 * TABLE_CLEARANCE:
                return 0.0, "the hand hits the table"
            local = (points - thing[:3]) @ quat_to_matrix(thing[3:])
            deepest = max(deepest, -float(self._fit.local_distance(local).min()))
            if deepest > self.config.most_depth:
                return deepest, "the hand enters the object"
        return deepest, ""


def build_recordings(
    hand: ShapedHand, config: BuildConfig, log: BuildLog, grips: tuple[str, ...]
) -> list[GraspRecording]:
    """All trials of all grip modes and the objects that suit them."""
    made: list[GraspRecording] = []
    names = sorted({name for grip in grips for name in MANNERS[grip].objects})
    things = {name: load_object(name) for name in names}
    fields = {name: DistanceField.of(thing, device="cpu") for name, thing in things.items()}
    solids = bone_solids(hand)
    for grip in grips:
        for name in MANNERS[grip].objects:
            builder = Builder(hand, grip, things[name], fields[name], solids, config, log)
            made += builder.recordings()
    return made
