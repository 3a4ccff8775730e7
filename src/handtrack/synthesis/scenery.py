"""Things beside the hand: an object before it, a piece of body or a wall behind it.

Their depth is computed ray by ray, so no meshes are needed. Depths in metres, 0 = nothing there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import palm_centre
from handtrack.synthesis.viewpoints import random_rotation
from handtrack.transforms import rotvec_to_matrix

Float = NDArray[np.float64]
Depth = NDArray[np.float32]

MOST_HIDDEN = 0.5
"""An occluder hides at most this share of the hand's and forearm's pixels."""

BODY_GAP = (0.1, 0.5)
"""Nearest and farthest distance of what is behind, from the palm [m]."""

_CLEARANCE = 0.03
"""What is behind keeps this far from the hand's farthest keypoint [m]."""

_FARTHEST = 6.0
"""Surfaces beyond are not seen [m]."""

_NEAR = 0.05


def camera_rays(camera: Camera) -> Float:
    """Ray through each pixel with z = 1, shape (height, width, 3)."""
    rays = np.ones((*camera.shape, 3))
    rays[..., 0] = (np.arange(camera.width) - camera.cx) / camera.fx
    rays[..., 1] = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
    return rays


def ellipsoid_depth(rays: Float, centre: Float, rotation: Float, half: Float) -> Depth:
    """Depth of an ellipsoid's front.

    Args:
        rays: Rays with z = 1, shape (height, width, 3).
        centre: Its centre [m], camera frame, shape (3,).
        rotation: Its axes as columns, camera frame, shape (3, 3).
        half: Half its axes [m], shape (3,).
    """
    # In the frame where it is the unit sphere.
    direction, origin = rays @ rotation / half, -(centre @ rotation) / half
    a = np.einsum("...i,...i->...", direction, direction)
    b = direction @ origin
    root = b * b - a * (origin @ origin - 1.0)
    depth = (-b - np.sqrt(np.maximum(root, 0.0))) / a
    return _visible(np.where(root > 0.0, depth, 0.0))


def box_depth(rays: Float, centre: Float, rotation: Float, half: Float) -> Depth:
    """Depth of a box' front; arguments as for `ellipsoid_depth`."""
    direction, origin = rays @ rotation, -(centre @ rotation)
    # A ray along a side would divide by zero; so small a step is far beyond the box.
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    first, second = (-half - origin) / direction, (half - origin) / direction
    enter = np.minimum(first, second).max(axis=-1)
    leave = np.maximum(first, second).min(axis=-1)
    return _visible(np.where(enter < leave, enter, 0.0))


def capsule_depth(rays: Float, start: Float, end: Float, radius: float) -> Depth:
    """Depth of the front of a cylinder with round ends.

    Args:
        rays: Rays with z = 1, shape (height, width, 3).
        start: One end of its axis [m], camera frame, shape (3,).
        end: The other end, not the same [m], shape (3,).
        radius: Of cylinder and ends [m].
    """
    axis = end - start
    squared = np.einsum("...i,...i->...", rays, rays)
    along = rays @ axis
    length = axis @ axis
    # The infinite cylinder, all terms times the squared length of the axis.
    a = length * squared - along**2
    b = -length * (rays @ start) + (start @ axis) * along
    c = length * (start @ start - radius**2) - (start @ axis) ** 2
    root = b * b - a * c
    depth = (-b - np.sqrt(np.maximum(root, 0.0))) / np.maximum(a, 1e-12)
    place = depth * along - start @ axis
    hit = np.where((root > 0.0) & (place > 0.0) & (place < length), depth, 0.0)
    # A ray that meets the cylinder beyond an end may still meet that end's ball.
    balls = [ellipsoid_depth(rays, end, np.eye(3), np.full(3, radius)) for end in (start, end)]
    return nearest(_visible(hit), nearest(*balls))


def plane_depth(rays: Float, point: Float, normal: Float) -> Depth:
    """Depth of the plane through a point [m], shape (3,), with a normal, shape (3,)."""
    along = rays @ normal
    with np.errstate(divide="ignore"):
        return _visible(np.where(np.abs(along) > 1e-9, (point @ normal) / along, 0.0))


def _visible(depth: Float) -> Depth:
    """Depth of surfaces before the camera and not too far, else 0."""
    return np.where((depth > _NEAR) & (depth < _FARTHEST), depth, 0.0).astype(np.float32)


def nearest(first: Depth, second: Depth) -> Depth:
    """The nearer one of two surfaces in every pixel."""
    both = np.minimum(first, second)
    return np.where(both > 0.0, both, np.maximum(first, second))


class DepthScene:
    """A depth image to which things are added, each computed only where it can be seen."""

    def __init__(self, camera: Camera) -> None:
        """Start with nothing in view of a camera."""
        self._camera = camera
        self._rays = camera_rays(camera)
        self.depth: Depth = np.zeros(camera.shape, np.float32)
        """Depth of all things so far [m], shape (height, width), 0 = nothing there."""

    def clear(self) -> None:
        """Start anew with nothing in view."""
        self.depth = np.zeros(self._camera.shape, np.float32)

    def add_image(self, depth: Depth) -> None:
        """Add what another renderer drew, depth [m], shape (height, width)."""
        self.depth = nearest(self.depth, depth)

    def add_plane(self, point: Float, normal: Float) -> None:
        """Add a plane; see `plane_depth`."""
        self.add_image(plane_depth(self._rays, point, normal))

    def add_ellipsoid(self, centre: Float, rotation: Float, half: Float) -> None:
        """Add an ellipsoid; see `ellipsoid_depth`."""
        box = self._window(centre, float(np.max(half)))
        self._merge(box, ellipsoid_depth(self._rays[box], centre, rotation, half))

    def add_box(self, centre: Float, rotation: Float, half: Float) -> None:
        """Add a box; see `box_depth`."""
        box = self._window(centre, float(np.linalg.norm(half)))
        self._merge(box, box_depth(self._rays[box], centre, rotation, half))

    def add_capsule(self, start: Float, end: Float, radius: float) -> None:
        """Add a cylinder with round ends; see `capsule_depth`."""
        reach = 0.5 * float(np.linalg.norm(end - start)) + radius
        box = self._window(0.5 * (start + end), reach)
        self._merge(box, capsule_depth(self._rays[box], start, end, radius))

    def _merge(self, box: tuple[slice, slice], depth: Depth) -> None:
        self.depth[box] = nearest(self.depth[box], depth)

    def _window(self, centre: Float, radius: float) -> tuple[slice, slice]:
        """Pixels that may see a ball: rows and columns."""
        camera = self._camera
        near = float(centre[2]) - radius
        if near < _NEAR:  # around the camera: it may be seen anywhere
            return slice(0, camera.height), slice(0, camera.width)
        found = []
        for place, focal, middle, size in (
            (centre[1], camera.fy, camera.cy, camera.height),
            (centre[0], camera.fx, camera.cx, camera.width),
        ):
            # Each side of the ball is widest in the image at its nearest or its farthest depth.
            sides = [(place + s * radius) / z for s in (-1, 1) for z in (near, near + 2 * radius)]
            low, high = focal * min(sides) + middle, focal * max(sides) + middle
            first = int(np.clip(math.floor(low), 0, size))
            found.append(slice(first, int(np.clip(math.ceil(high) + 1, first, size))))
        return found[0], found[1]


def add_occluder(
    depth: Depth, rays: Float, keypoints: Float, rng: np.random.Generator
) -> tuple[Depth, float]:
    """Put a ball or a bar between the camera and a part of the hand.

    Args:
        depth: Depth of the hand [m], shape (height, width).
        rays: Rays of its camera, shape (height, width, 3).
        keypoints: The hand's keypoints [m], camera frame, shape (21, 3).
        rng: Source of the random numbers.

    Returns:
        Depth of both [m], and the share of the hand's pixels that is hidden. An occluder that hides
        more than `MOST_HIDDEN`, even when made smaller, is left out.
    """
    ball = rng.random() < 0.5
    half = rng.uniform(0.008, 0.03, 3)
    half[0] = half[0] if ball else rng.uniform(0.03, 0.15)
    rotation = random_rotation(rng)
    target = keypoints[rng.integers(len(keypoints))] + rng.normal(0.0, 0.015, 3)
    before = rng.uniform(0.55, 0.95)
    hand = depth > 0.0
    for shrink in (1.0, 0.6, 0.35):
        sides = shrink * half
        reach = float(np.abs(rotation[2] * sides).sum())  # nothing of it is farther in z than this
        z = min(before * target[2], keypoints[:, 2].min() - reach - 0.01)
        z = max(z, _NEAR + reach)
        centre = target * (z / target[2])
        shape = ellipsoid_depth if ball else box_depth
        thing = shape(rays, centre, rotation, sides)
        hidden = hand & (thing > 0.0) & (thing < depth)
        share = float(hidden.sum() / max(hand.sum(), 1))
        if share <= MOST_HIDDEN:
            return nearest(depth, thing), share
    return depth, 0.0


def add_body(depth: Depth, rays: Float, keypoints: Float, rng: np.random.Generator) -> Depth:
    """Put a wall, a table or a rounded piece of body behind the hand.

    The forearm may end in it, as arms do. Arguments as for `add_occluder`; returns the depth of all
    [m], shape (height, width).
    """
    palm = palm_centre(keypoints)
    gap = rng.uniform(*BODY_GAP)
    z = max(palm[2] + gap, float(keypoints[:, 2].max()) + _CLEARANCE)
    if rng.random() < 0.5:
        tilt = rng.uniform(0.0, math.radians(35.0))
        way = rng.uniform(0.0, 2 * math.pi)
        axis = np.array([math.cos(way), math.sin(way), 0.0])
        normal = rotvec_to_matrix(tilt * axis)[:, 2]
        # Far enough along its normal that no keypoint lies behind a tilted plane.
        farthest = float((keypoints @ normal).max()) + _CLEARANCE
        point = np.array([palm[0], palm[1], z])
        point = point + normal * max(farthest - point @ normal, 0.0)
        return nearest(depth, plane_depth(rays, point, normal))
    half = rng.uniform([0.10, 0.15, 0.08], [0.30, 0.50, 0.20])
    turn = rotvec_to_matrix(np.array([0.0, 0.0, rng.uniform(0.0, math.pi)]))
    aside = rng.uniform(-0.2, 0.2, 2)
    centre = np.array([palm[0] + aside[0], palm[1] + aside[1], z + half[2]])
    return nearest(depth, ellipsoid_depth(rays, centre, turn, half))
