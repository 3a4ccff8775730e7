"""Round cylinders against sphere tracing, and scenes that compute each thing where it is seen."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.synthesis.scenery import (
    DepthScene,
    box_depth,
    camera_rays,
    capsule_depth,
    ellipsoid_depth,
    nearest,
    plane_depth,
)
from handtrack.synthesis.viewpoints import random_rotation
from oracles.scenes import SMALL_CAMERA

RAYS = camera_rays(SMALL_CAMERA)


def traced_capsule(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Depth of a capsule's front by walking along every ray as far as is safe."""
    unit = RAYS / np.linalg.norm(RAYS, axis=-1, keepdims=True)
    way = np.zeros(RAYS.shape[:2])
    axis = end - start
    for _ in range(300):
        points = way[..., None] * unit
        share = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
        distance = np.linalg.norm(points - start - share[..., None] * axis, axis=-1) - radius
        way = np.where(way < 5.0, way + distance, way)
    return np.where(np.abs(distance) < 1e-5, way * unit[..., 2], 0.0)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((-0.1, 0.05, 0.5), (0.12, -0.04, 0.6)),
        ((0.0, 0.0, 0.4), (0.02, 0.01, 0.9)),  # almost along the optical axis
        ((0.05, 0.1, 0.6), (0.05, -0.1, 0.6)),
        ((0.2, 0.3, 0.5), (0.25, 0.1, 0.45)),  # partly out of view
    ],
)
def test_round_cylinders_are_where_rays_meet_them(
    start: tuple[float, ...], end: tuple[float, ...]
) -> None:
    a, b = np.array(start), np.array(end)
    depth, true = capsule_depth(RAYS, a, b, 0.04), traced_capsule(a, b, 0.04)
    both = (depth > 0) & (true > 0)
    assert both.sum() > 100
    # Walking slows down at grazing rays and may stop short of the outline.
    assert ((depth > 0) != (true > 0)).sum() <= 0.02 * both.sum() + 2
    assert np.abs(depth - true)[both].max() < 1e-3
    np.testing.assert_array_equal(capsule_depth(RAYS, b, a, 0.04), depth)


def test_things_in_a_scene_are_those_of_the_whole_image(rng: np.random.Generator) -> None:
    scene, expected = DepthScene(SMALL_CAMERA), np.zeros(SMALL_CAMERA.shape, np.float32)
    for _ in range(40):
        # In view, at its border, beside it, and around the camera itself.
        centre = rng.uniform([-0.5, -0.4, 0.0], [0.5, 0.4, 1.2])
        half, rotation = rng.uniform(0.02, 0.15, 3), random_rotation(rng)
        end = centre + rng.normal(0.0, 0.15, 3)
        scene.add_ellipsoid(centre, rotation, half)
        scene.add_box(centre, rotation, 0.5 * half)
        scene.add_capsule(centre, end, 0.3 * half[0])
        for depth in (
            ellipsoid_depth(RAYS, centre, rotation, half),
            box_depth(RAYS, centre, rotation, 0.5 * half),
            capsule_depth(RAYS, centre, end, 0.3 * half[0]),
        ):
            expected = nearest(expected, depth)
        np.testing.assert_array_equal(scene.depth, expected)
    assert (scene.depth > 0).mean() > 0.3
    wall = plane_depth(RAYS, np.array([0.0, 0.0, 2.0]), np.array([0.1, 0.0, 1.0]))
    scene.add_plane(np.array([0.0, 0.0, 2.0]), np.array([0.1, 0.0, 1.0]))
    np.testing.assert_array_equal(scene.depth, nearest(expected, wall))
    scene.clear()
    assert not scene.depth.any()
    scene.add_image(wall)
    np.testing.assert_array_equal(scene.depth, wall)
