"""People in front of a depth camera, of ellipsoids and round cylinders: scenes that a hand is in.

The body frame has its origin midway between the shoulders, x to the person's left, y down and z
backwards, so that it is turned like the camera frame when the person faces the camera. Lengths are
those of an adult of 1.75 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.synthesis.scenery import DepthScene
from handtrack.transforms import rotvec_to_matrix

Float = NDArray[np.float64]

Arms = Literal["hanging", "akimbo"]

SHOULDER = (0.185, 0.04, 0.0)
"""Left shoulder joint [m], body frame; the right one lies at -x."""

_Place = tuple[float, float, float]

_ELLIPSOIDS: tuple[tuple[_Place, _Place], ...] = (
    ((0.0, -0.215, -0.015), (0.076, 0.112, 0.098)),  # head
    ((0.0, -0.235, 0.005), (0.082, 0.098, 0.100)),  # hair
    ((0.0, -0.150, -0.055), (0.048, 0.055, 0.050)),  # jaw
    ((0.0, -0.195, -0.112), (0.013, 0.025, 0.018)),  # nose
    ((0.0, 0.170, -0.010), (0.180, 0.260, 0.115)),  # chest
    ((0.0, 0.400, -0.015), (0.160, 0.260, 0.120)),  # belly
    ((0.0, 0.600, 0.000), (0.180, 0.160, 0.130)),  # hips
)
"""Centre and half axes [m], body frame."""

_CAPSULES: tuple[tuple[_Place, _Place, float], ...] = (
    ((0.0, -0.02, 0.015), (0.0, -0.14, 0.0), 0.056),  # neck
    ((0.03, -0.045, 0.015), (0.165, 0.03, 0.01), 0.046),  # slope of the shoulders
    ((-0.03, -0.045, 0.015), (-0.165, 0.03, 0.01), 0.046),
    ((-0.14, 0.06, 0.0), (0.14, 0.06, 0.0), 0.075),  # across the chest
    ((0.09, 0.12, 0.0), (0.085, 0.55, 0.0), 0.092),  # flanks
    ((-0.09, 0.12, 0.0), (-0.085, 0.55, 0.0), 0.092),
    ((0.09, 0.62, -0.02), (0.10, 0.75, -0.42), 0.075),  # thighs of a seated person
    ((-0.09, 0.62, -0.02), (-0.10, 0.75, -0.42), 0.075),
)
"""Both ends and radius [m], body frame."""

_ARMS: dict[str, tuple[_Place, _Place]] = {
    "hanging": ((0.225, 0.32, 0.02), (0.22, 0.57, -0.04)),
    "akimbo": ((0.36, 0.25, 0.09), (0.14, 0.40, 0.16)),
}
"""Left elbow and wrist [m], body frame; akimbo, the hands are behind the back."""

_UPPER_ARM, _FOREARM = 0.052, 0.038
"""Radius of the arm's parts, with a sleeve [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """Somebody without hands: arms end at the wrist, or at the elbow of a hand drawn elsewhere."""

    chest: tuple[float, float, float]
    """Point midway between the shoulders [m], camera frame."""
    turn: float = 0.0
    """Turn about the vertical [rad], positive to the person's right; 0 faces the camera."""
    size: float = 1.0
    """Size of the body, 1 for 1.75 m."""
    arms: Arms = "hanging"
    """Where the arms are that no hand is given to."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        if self.arms not in _ARMS:
            raise InputError(f"arms is {self.arms!r}: expected one of {', '.join(_ARMS)}")
        if not 0.3 <= self.size <= 2.0:
            raise InputError(f"size is {self.size}: expected 0.3 to 2")

    def add_to(self, scene: DepthScene, *, right_elbow: Float | None = None) -> None:
        """Draw the person.

        Args:
            scene: Where to.
            right_elbow: Elbow of the raised right arm [m], camera frame, shape (3,), whose forearm
                and hand are drawn elsewhere; None leaves that arm like the other.
        """
        rotation = rotvec_to_matrix(np.array([0.0, self.turn, 0.0]))

        def placed(point: _Place, side: int = 1) -> Float:
            return self.size * rotation @ (np.array(point) * [side, 1, 1]) + self.chest

        for centre, half in _ELLIPSOIDS:
            scene.add_ellipsoid(placed(centre), rotation, self.size * np.array(half))
        for start, end, radius in _CAPSULES:
            scene.add_capsule(placed(start), placed(end), self.size * radius)
        for side in (1, -1):
            shoulder = placed(SHOULDER, side)
            if side == -1 and right_elbow is not None:
                scene.add_capsule(shoulder, right_elbow, self.size * _UPPER_ARM)
                continue
            elbow, wrist = (placed(point, side) for point in _ARMS[self.arms])
            scene.add_capsule(shoulder, elbow, self.size * _UPPER_ARM)
            scene.add_capsule(elbow, wrist, self.size * _FOREARM)


def cloth_folds(
    camera: Camera, rng: np.random.Generator, *, height: float = 0.004, grain: float = 0.04
) -> NDArray[np.float32]:
    """Unevenness of clothes and walls, to add to the depth of smooth bodies [m].

    Args:
        camera: Camera of the image.
        rng: Source of the random numbers.
        height: Its standard deviation [m].
        grain: Size of its folds, the sigma of the Gaussian that smooths it [rad].

    Returns:
        Shape (height, width).
    """
    sigma = grain * camera.fx
    noise = rng.standard_normal(camera.shape).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    # Smoothing lowers the deviation by 2 sqrt(pi) sigma.
    return noise * np.float32(height * 2.0 * math.sqrt(math.pi) * sigma)
