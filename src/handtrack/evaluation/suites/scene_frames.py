"""Frames of whole scenes: walls, people, a moving hand, a cup, things held in front of the hand.

The scenes are entries of `benchmarks/scenes.toml`; every part is drawn with its depth, the nearest
surface is seen, and the sensor's noise comes last.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import InputError
from handtrack.evaluation.suites.fist import keyframe_track, turned
from handtrack.evaluation.suites.suite import SuiteSettings
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.people import Person, cloth_folds
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.scenery import DepthScene
from handtrack.synthesis.sequence import worn_by
from handtrack.synthesis.things import MeshRenderer, cup_mesh
from handtrack.transforms import moved_poses, quat_to_matrix

Float = NDArray[np.float64]

IN_VIEW = 0.5
"""A hand is in view when at least this share of its keypoints is inside the image."""

_SWAY_PERIOD = (97.0, 61.0, 143.0)
"""Frames in which a standing person sways once, along x, y and z."""

_SWAY_SHARE = np.array([1.0, 0.15, 0.7])
"""How far along each of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFrames:
    """Rendered frames of one scene."""

    case: str
    """Name of the scene."""
    frames: list[DepthFrame]
    """The frames; those in which a part of the hand can be seen carry its truth."""
    in_view: NDArray[np.bool_]
    """Frames with at least `IN_VIEW` of the hand's keypoints inside the image, shape (n,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _MovingHand:
    """A hand with its forearm, in every frame of a scene."""

    poses: Float
    elbows: Float
    keypoints: Float
    inside: NDArray[np.int64]
    """Number of keypoints inside the image, shape (n,)."""
    depth: NDArray[np.float32]


def render_scene(
    plan: Mapping[str, Any], data: Mapping[str, Any], settings: SuiteSettings, hand: ShapedHand
) -> SceneFrames:
    """Draw all frames of a scene.

    Args:
        plan: The scene's entry in `benchmarks/scenes.toml`.
        data: The suite's `camera`, `motion`, `folds` and `stride`.
        settings: Device and seed of the noise.
        hand: The subject's hand.

    Raises:
        InputError: The scene asks for something that there is not.
    """
    camera = Camera.from_dict(data["camera"])
    name, count = str(plan["case"]), int(plan["frames"])
    numbers = np.arange(0, count, int(data["stride"]))
    # Each scene has random numbers of its own, whatever other scenes there are.
    stream = [settings.seed, zlib.crc32(name.encode())]
    folds = cloth_folds(camera, np.random.default_rng(stream), height=float(data["folds"]))
    moving = _moving_hand(plan.get("hand"), data, camera, hand, numbers, count, settings)
    cup = None
    if "cup" in plan:
        keys = plan["cup"]["keys"]
        cup = MeshRenderer(cup_mesh(), camera, device=settings.device), _placed(keys, count)
    noise = noise_preset(plan["noise"])

    frames, scene = [], DepthScene(camera)
    shown = settings.progress(numbers.tolist(), len(numbers), f"rendering {name}")
    for place, number in enumerate(shown):
        scene.clear()
        if "wall" in plan:
            tilt = turned(np.radians([[*plan["wall"]["tilt"], 0.0]]))[0]
            scene.add_plane(np.array([0.0, 0.0, plan["wall"]["distance"]]), tilt[:, 2])
        for index, body in enumerate(plan.get("people", ())):
            raised = body["arms"] == "raised"
            if raised and moving is None:
                raise InputError(f"scene {name} has a raised arm but no hand")
            elbow = moving.elbows[place] if raised and moving is not None else None
            _person(body, number, index).add_to(scene, right_elbow=elbow)
        scene.depth = np.where(scene.depth > 0, scene.depth + folds, 0.0).astype(np.float32)
        if cup is not None:
            renderer, (rotations, places) = cup
            scene.add_image(renderer.render(rotations[number], places[number]))
        if moving is not None:
            scene.add_image(moving.depth[place])
            if "held" in plan:
                _hold(plan["held"], moving, place, scene)
        depth = scene.depth
        if "reach" in plan:
            depth = np.where(depth <= plan["reach"], depth, 0.0)
        rng = np.random.default_rng([*stream, number])
        frames.append(
            DepthFrame(
                depth=noise.apply(depth, camera, rng),
                camera=camera,
                index=number,
                name=f"{name}[{number}]",
                truth=_truth(moving, place),
            )
        )
    return SceneFrames(case=name, frames=frames, in_view=_in_view(moving, len(numbers)))


def _truth(moving: _MovingHand | None, place: int) -> FrameTruth | None:
    """Truth of a frame, None where nothing of a hand can be seen."""
    if moving is None or not moving.inside[place]:
        return None
    return FrameTruth(
        keypoints=moving.keypoints[place].astype(np.float32), pose=moving.poses[place],
        side="right",
    )  # fmt: skip


def _in_view(moving: _MovingHand | None, count: int) -> NDArray[np.bool_]:
    """Frames with the hand in view, shape (n,)."""
    if moving is None:
        return np.zeros(count, bool)
    return moving.inside >= IN_VIEW * moving.keypoints.shape[1]


def _moving_hand(
    plan: Mapping[str, Any] | None,
    data: Mapping[str, Any],
    camera: Camera,
    hand: ShapedHand,
    numbers: NDArray[np.int64],
    count: int,
    settings: SuiteSettings,
) -> _MovingHand | None:
    """The recorded motion, turned and moved as a whole, and along a track of its own."""
    if plan is None:
        return None
    motion = Motion.load(data["motion"]).take(*plan["frames"])
    if len(motion) < count:
        raise InputError(f"the hand moves for {len(motion)} frames, the scene takes {count}")
    poses, elbows = worn_by(motion, hand)
    poses, elbows = poses[:count], elbows[:count]
    rotation = turned(np.radians([plan["turn"]]))[0]
    middle = poses[:, :3].mean(axis=0)
    shift = np.array(plan["place"], np.float64) + np.zeros((count, 1))
    if "shift" in plan:
        keys, shifts = zip(*plan["shift"], strict=True)
        shift = shift + keyframe_track(keys, shifts, count)
    moved = moved_poses(poses, rotation, shift - rotation @ middle)
    elbows = (elbows - middle) @ rotation.T + shift
    moved, elbows = moved[numbers], elbows[numbers]
    points = keypoints(hand, moved)
    # NaN, a point behind the camera, is not inside.
    pixels = camera.project(points)
    inside = (pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)
    renderer = DepthRenderer(hand, camera, device=settings.device)
    return _MovingHand(
        poses=moved,
        elbows=elbows,
        keypoints=points,
        inside=inside.all(axis=-1).sum(axis=-1),
        depth=renderer.render(moved, elbows=elbows),
    )


def _person(body: Mapping[str, Any], number: int, index: int) -> Person:
    """Somebody who stands almost still."""
    time = 2.0 * np.pi * (number / np.array(_SWAY_PERIOD) + 0.37 * index)
    chest = np.array(body["chest"]) + float(body["sway"]) * _SWAY_SHARE * np.sin(time)
    turn = np.radians(float(body["turn"])) + 2.0 * float(body["sway"]) * np.sin(time[2])
    arms = "hanging" if body["arms"] == "raised" else body["arms"]
    return Person(
        chest=(chest[0], chest[1], chest[2]), turn=float(turn), size=float(body["size"]), arms=arms
    )


def _placed(keys: Any, count: int) -> tuple[Float, Float]:
    """Rotations, shape (n, 3, 3), and places [m], shape (n, 3), between keyframes."""
    frames = [key["frame"] for key in keys]
    turns = keyframe_track(frames, np.radians([key["turn"] for key in keys]), count)
    return turned(turns), keyframe_track(frames, [key["place"] for key in keys], count)


def _hold(held: Mapping[str, Any], moving: _MovingHand, place: int, scene: DepthScene) -> None:
    """Draw a ball or a box that moves with the palm."""
    rotation = quat_to_matrix(moving.poses[place, 3:7])
    centre = palm_centre(moving.keypoints[place]) + rotation @ np.array(held["offset"])
    half = np.array(held["half"], np.float64)
    if held["kind"] == "ball":
        scene.add_ellipsoid(centre, rotation, half)
    elif held["kind"] == "box":
        scene.add_box(centre, rotation, half)
    else:
        raise InputError(f"the hand holds a {held['kind']!r}: expected 'ball' or 'box'")
