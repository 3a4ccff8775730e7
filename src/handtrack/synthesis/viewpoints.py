"""Where the camera sees the hand from: any direction, any roll, the whole hand in view."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import palm_centre
from handtrack.transforms import quat_to_matrix, rotvec_to_matrix

Float = NDArray[np.float64]

R_CAMERA_UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_camera_palm of a right hand with fingers up and palm to the camera."""

FLESH = 0.012
"""Distance kept between keypoints, which lie inside the hand, and the border of the image [m]."""

NEAREST = 0.1
"""Nearest that hand and elbow come to the camera [m]: they cannot pass through it."""

WRIST_FLEXION = (math.radians(25.0), math.radians(-70.0), math.radians(70.0))
"""Deviation and limits of the wrist's bend towards palm and back [rad]."""

WRIST_DEVIATION = (math.radians(10.0), math.radians(-20.0), math.radians(35.0))
"""Deviation and limits of the wrist's bend to the thumb's (negative) and the other side [rad]."""

FOREARM = (0.20, 0.28)
"""Shortest and longest forearm [m]."""


def random_rotation(rng: np.random.Generator) -> Float:
    """R_camera_palm, shape (3, 3), uniform: every palm direction and every roll is as likely."""
    return quat_to_matrix(_unit(rng.standard_normal(4)))


def random_elbow(rng: np.random.Generator) -> Float:
    """Elbow [m], palm frame, shape (3,), of a wrist bent at random.

    The wrist bends up and down more than sideways; limits after the joint's usual range.
    """
    bends = [
        float(np.clip(rng.normal(0.0, spread), low, high))
        for spread, low, high in (WRIST_FLEXION, WRIST_DEVIATION)
    ]
    # The forearm lies along -x; turning about z bends it towards palm or back, about y sideways.
    turn = rotvec_to_matrix(np.array([0.0, 0.0, bends[0]]))
    turn = turn @ rotvec_to_matrix(np.array([0.0, bends[1], 0.0]))
    return -rng.uniform(*FOREARM) * turn[:, 0]


def place_in_view(
    keypoints: ArrayLike,
    elbow: ArrayLike,
    camera: Camera,
    rng: np.random.Generator,
    *,
    distance: tuple[float, float],
) -> Float:
    """Translation that puts a turned hand before the camera, all keypoints in view.

    The palm's depth is uniform over the part of the range where the hand fits into the image, its
    place in the image uniform over what is then left; the elbow may lie outside.

    Args:
        keypoints: Keypoints [m], already turned into the camera's axes, shape (21, 3).
        elbow: Elbow [m], likewise, shape (3,).
        camera: The camera.
        rng: Source of the random numbers.
        distance: Smallest and largest depth of the palm's centre [m].

    Returns:
        What to add to the keypoints [m], shape (3,).

    Raises:
        InputError: The hand does not fit into the image even at the largest distance.
    """
    points = np.asarray(keypoints, np.float64)
    middle = palm_centre(points)
    x, y, z = (points - middle).T
    nearest = min(float(z.min()), float(np.asarray(elbow, np.float64)[2] - middle[2]))
    # Slopes x / z of the image's borders.
    across = (np.array([-0.5, camera.width - 0.5]) - camera.cx) / camera.fx
    down = (np.array([-0.5, camera.height - 0.5]) - camera.cy) / camera.fy
    low = max(distance[0], NEAREST - nearest, _fits_from(x, z, across), _fits_from(y, z, down))
    if low > distance[1]:
        raise InputError(
            f"the hand fits into the image of {camera.width}x{camera.height} from {low:.2f} m: "
            f"raise the largest distance of {distance[1]:g} m, or take a camera with a wider view"
        )
    depth = rng.uniform(low, distance[1])
    place = [rng.uniform(*_room(a, z, depth, s)) for a, s in ((x, across), (y, down))]
    return np.array([*place, depth]) - middle


def _room(x: Float, z: Float, depth: float, slopes: Float) -> tuple[float, float]:
    """Smallest and largest shift along one axis [m] that keeps all points between two borders."""
    low, high = slopes[:, None] * (z + depth) - x
    return float(low.max() + FLESH), float(high.min() - FLESH)


def _fits_from(x: Float, z: Float, slopes: Float) -> float:
    """Depth [m] from which there is room between the borders."""
    # Room at depth d is that at 0 plus the opening between the borders.
    low, high = _room(x, z, 0.0, slopes)
    return (low - high) / float(slopes[1] - slopes[0])


def _unit(vector: Float) -> Float:
    return vector / np.linalg.norm(vector)
