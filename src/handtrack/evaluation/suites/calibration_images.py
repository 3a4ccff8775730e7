"""Depth images that a person would be asked for: named poses, shown to the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.poses import load_poses
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.synthesis.viewpoints import R_CAMERA_UPRIGHT, place_in_view, random_elbow
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationImages:
    """Images of one hand, with the truth."""

    camera: Camera
    """The camera."""
    depths: NDArray[np.float32]
    """Depth images [m], shape (n, height, width)."""
    poses: Float
    """True poses, shape (n, 28)."""


def calibration_images(
    hand: ShapedHand, data: Mapping[str, Any], seed: list[int], *, device: str | None
) -> CalibrationImages:
    """Render the images of a right hand.

    Args:
        hand: The hand.
        data: `camera`, `noise`, `poses` (names), `distance` (nearest and farthest [m]), `tilt`
            (largest turn about each axis away from facing the camera [degrees]) and `jitter`
            (deviation of a joint angle from the named pose [degrees]).
        seed: Seed of everything drawn.
        device: "cpu", "cuda:N" or None for the best there is.
    """
    rng = np.random.default_rng(seed)
    camera, noise = Camera.from_dict(data["camera"]), noise_preset(data["noise"])
    named = load_poses()
    poses, elbows = [], []
    for name in data["poses"]:
        angles = named[name] + np.radians(data["jitter"]) * rng.standard_normal(21)
        turn = rotvec_to_matrix(np.radians(data["tilt"]) * rng.uniform(-1.0, 1.0, 3))
        rotation = turn @ R_CAMERA_UPRIGHT
        pose = np.concatenate([
            np.zeros(3), matrix_to_quat(rotation), angles.clip(*hand.limits.T),
        ])  # fmt: skip
        elbow = rotation @ random_elbow(rng)
        low, high = data["distance"]
        pose[:3] = place_in_view(keypoints(hand, pose), elbow, camera, rng, distance=(low, high))
        poses.append(pose)
        elbows.append(elbow + pose[:3])
    clean = DepthRenderer(hand, camera, device=device).render(poses, elbows=np.stack(elbows))
    return CalibrationImages(
        camera=camera, depths=np.stack([noise.apply(image, camera, rng) for image in clean]),
        poses=np.stack(poses),
    )  # fmt: skip
