"""Objects by name: those of the grasp database and those that grasping is tested on.

None of the test objects, or of their sizes, is in the database (thesis Fig. III.4 and III.7).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from handtrack.errors import InputError
from handtrack.objects import shapes
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import Shape


def _apple() -> Shape:
    angles = np.linspace(0.0, np.pi, 15)
    # Flat ends and wide shoulders: radius and height of a slightly squared circle.
    radius = 0.038 * np.sin(angles) ** 0.85
    height = -0.034 * np.sign(np.cos(angles)) * np.abs(np.cos(angles)) ** 0.9
    radius[[0, -1]] = 0.010
    return shapes.turned([*zip(radius.tolist(), height.tolist(), strict=True)])


def _pear() -> Shape:
    profile = [
        (0.012, 0.000), (0.026, 0.008), (0.033, 0.022), (0.034, 0.032), (0.031, 0.046),
        (0.024, 0.062), (0.018, 0.076), (0.014, 0.086), (0.007, 0.092),
    ]  # fmt: skip
    return shapes.turned(profile)


def _banana() -> Shape:
    angles = np.linspace(-1.0, 1.0, 15)
    middle = np.stack(
        [0.095 * np.cos(angles), 0.095 * np.sin(angles), np.zeros_like(angles)], axis=1
    )
    thick = 0.017 * np.sqrt(np.maximum(1.0 - (np.abs(angles) / 1.06) ** 4, 0.02))
    return shapes.tube(middle, thick)


def _bottle() -> Shape:
    profile = [
        (0.027, 0.0), (0.029, 0.004), (0.029, 0.095), (0.026, 0.108), (0.016, 0.124),
        (0.013, 0.132), (0.013, 0.155),
    ]  # fmt: skip
    return shapes.turned(profile)


def _can() -> Shape:
    profile = [(0.0295, 0.0), (0.033, 0.006), (0.033, 0.104), (0.0285, 0.112), (0.0285, 0.115)]
    return shapes.turned(profile)


def _goblet() -> Shape:
    outside = [
        (0.032, 0.0), (0.032, 0.004), (0.009, 0.012), (0.008, 0.050), (0.014, 0.058),
        (0.030, 0.074), (0.036, 0.096), (0.034, 0.130),
    ]  # fmt: skip
    return shapes.vessel(outside, 0.004, 0.006, foot=4)


def _cup() -> Shape:
    body = shapes.vessel([(0.036, 0.0), (0.040, 0.006), (0.040, 0.085)], 0.004, 0.006)
    angles = np.linspace(-1.35, 1.35, 9)
    arc = np.stack(
        [0.037 + 0.026 * np.cos(angles), np.zeros_like(angles), 0.045 + 0.026 * np.sin(angles)],
        axis=1,
    )
    return shapes.joined([body, shapes.tube(arc, np.full(len(arc), 0.006))])


def _bunny() -> Shape:
    def part(size: tuple[float, float, float], at: tuple[float, float, float]) -> Shape:
        return shapes.moved(shapes.ellipsoid(*size), at)

    def ear(y: float, tilt: float) -> Shape:
        upright = shapes.ellipsoid(0.014, 0.018, 0.052)
        return shapes.moved(upright, (-0.018, y, 0.106), turn=(tilt, -0.2, 0.0))

    # It sits on a flat bottom, or it would roll away.
    seat = shapes.ellipsoid(0.078, 0.066, 0.064).mesh.vertices.clip(min=[-1.0, -1.0, -0.024])
    body = shapes.moved(shapes.convex(seat), (0.012, 0.0, 0.032))
    head = part((0.046, 0.044, 0.044), (-0.022, 0.0, 0.072))
    tail = part((0.022, 0.022, 0.022), (0.050, 0.0, 0.030))
    return shapes.joined([body, head, tail, ear(0.011, -0.15), ear(-0.011, 0.15)])


def _hammer() -> Shape:
    handle = shapes.moved(shapes.lying_cylinder(0.026, 0.18), (0.0, 0.0, 0.020))
    head = shapes.moved(shapes.box(0.076, 0.028, 0.030), (0.0, 0.086, 0.020))
    return shapes.joined([handle, head])


def _egg() -> Shape:
    angles = np.linspace(0.0, np.pi, 13)
    radius = 0.0225 * np.sin(angles) * (1.0 + 0.10 * np.cos(angles))
    height = -0.029 * np.cos(angles)
    radius[[0, -1]] = 0.004
    return shapes.turned([*zip(radius.tolist(), height.tolist(), strict=True)])


_DATABASE: dict[str, tuple[Callable[[], Shape], float]] = {
    "ball_45": (lambda: shapes.sphere(0.045), 0.06),
    "ball_65": (lambda: shapes.sphere(0.065), 0.10),
    "ball_85": (lambda: shapes.sphere(0.085), 0.16),
    "block_40_40_60": (lambda: shapes.box(0.040, 0.040, 0.060), 0.08),
    "block_60_60_80": (lambda: shapes.box(0.060, 0.060, 0.080), 0.16),
    "block_30_80_50": (lambda: shapes.box(0.030, 0.080, 0.050), 0.10),
    "block_80_80_80": (lambda: shapes.box(0.080, 0.080, 0.080), 0.25),
    "cylinder_35_100": (lambda: shapes.cylinder(0.035, 0.100), 0.10),
    "cylinder_55_120": (lambda: shapes.cylinder(0.055, 0.120), 0.20),
    "cylinder_75_60": (lambda: shapes.cylinder(0.075, 0.060), 0.16),
}

_TEST: dict[str, tuple[Callable[[], Shape], float]] = {
    "sphere_55": (lambda: shapes.sphere(0.055), 0.09),
    "sphere_75": (lambda: shapes.sphere(0.075), 0.14),
    "box_50_70_60": (lambda: shapes.box(0.050, 0.070, 0.060), 0.12),
    "box_35_35_110": (lambda: shapes.box(0.035, 0.035, 0.110), 0.12),
    "cylinder_45_90": (lambda: shapes.cylinder(0.045, 0.090), 0.12),
    "cylinder_65_100": (lambda: shapes.cylinder(0.065, 0.100), 0.20),
    "cube_50": (lambda: shapes.box(0.050, 0.050, 0.050), 0.10),
    "cube_70": (lambda: shapes.box(0.070, 0.070, 0.070), 0.18),
    "cube_90": (lambda: shapes.box(0.090, 0.090, 0.090), 0.25),
    "cube_110": (lambda: shapes.box(0.110, 0.110, 0.110), 0.30),
    "prism_6": (lambda: shapes.prism(6, 0.060, 0.080), 0.14),
    "pyramid": (lambda: shapes.pyramid(0.070, 0.080), 0.12),
    "cone": (lambda: shapes.frustum(32, 0.070, 0.016, 0.090), 0.12),
    "egg": (_egg, 0.06),
    "apple": (_apple, 0.18),
    "pear": (_pear, 0.16),
    "banana": (_banana, 0.12),
    "can": (_can, 0.30),
    "bottle": (_bottle, 0.25),
    "cup": (_cup, 0.20),
    "goblet": (_goblet, 0.15),
    "bunny": (_bunny, 0.15),
    "hammer": (_hammer, 0.20),
}

DATABASE_OBJECTS: tuple[str, ...] = tuple(_DATABASE)
"""Spheres, blocks and cylinders of the grasp database; numbers are millimetres."""

TEST_OBJECTS: tuple[str, ...] = tuple(_TEST)
"""Objects for tests and benchmarks, none of them in the database."""


def load_object(name: str) -> RigidObject:
    """The object of that name.

    Raises:
        InputError: There is none.
    """
    known = {**_DATABASE, **_TEST}
    if name not in known:
        raise InputError(f"no object {name!r}; there are {', '.join(known)}")
    make, mass = known[name]
    return RigidObject.of_shape(make(), name=name, mass=mass)
