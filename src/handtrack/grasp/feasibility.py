"""Whether contacts can carry an object at rest: the linear program of Eq. III.10 to III.16.

Each contact is a small soft patch, stood for by four points around its centre, so that it can also
hold torques about its normal. Friction and normal force are eliminated: a point's force is
B lambda with lambda >= 0, edges of its friction pyramid with a normal part of one, so Eq. III.13 to
III.16 hold by construction and the sum of normal forces is the sum of all lambda.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog, nnls

from handtrack.errors import InputError
from handtrack.grasp.contact_forces import pyramid

Float = NDArray[np.float64]

PATCH_POINTS = 4
"""Points of a contact patch (thesis III.4.1.3)."""

PATCH_RADIUS = 0.004
"""Distance of a patch's points from its centre [m]: a fingertip pressed with a few newtons."""

CONE_EDGES = 4
"""Edges of a point's friction pyramid (thesis III.4.1.3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeasibilityResult:
    """Outcome of the test."""

    feasible: bool
    """Whether there are forces that hold the object."""
    normal_forces: Float
    """Least normal forces that do [N], one per contact; NaN where there are none."""


def feasible(
    points: ArrayLike,
    normals: ArrayLike,
    *,
    friction: float,
    mass: float,
    gravity: ArrayLike = (0.0, 0.0, -9.81),
    largest_force: float | None = 20.0,
    patch_radius: float = PATCH_RADIUS,
) -> FeasibilityResult:
    """Test contacts.

    Args:
        points: Centres of the patches from the object's centre of mass [m], shape (ncontact, 3).
        normals: Outward unit normals of the object there, shape (ncontact, 3).
        friction: Coefficient of sliding friction.
        mass: Mass of the object [kg].
        gravity: Acceleration of gravity in the same frame [m/s^2].
        largest_force: Largest normal force of a contact [N], a finger's strength; None: any.
        patch_radius: Distance of a patch's four points from its centre [m].

    Raises:
        InputError: Shapes do not fit, or mass, friction or radius are out of range.
    """
    centres, outward = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    if centres.ndim != 2 or centres.shape[1] != 3 or outward.shape != centres.shape:
        raise InputError(
            f"contacts have shape {centres.shape} and normals {outward.shape}; expected both (n, 3)"
        )
    if not (mass > 0 and friction >= 0 and patch_radius >= 0):
        raise InputError(
            f"mass is {mass} kg, friction {friction} and patch radius {patch_radius} m; expected a "
            "mass of more than 0 and the others at least 0"
        )
    count = len(centres)
    if count == 0:
        return FeasibilityResult(feasible=False, normal_forces=np.zeros(0))
    basis = pyramid(-outward, friction, CONE_EDGES)  # (ncontact, 3, edges)
    # The pyramid's edges lie along tangents; the patch's points stand out in these directions.
    tangents = basis + outward[:, :, None]
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    corners = centres[:, None] + patch_radius * np.moveaxis(tangents, 1, 2)
    # Columns: contact, patch point, edge.
    edges = np.broadcast_to(
        np.moveaxis(basis, 1, 2)[:, None], (count, PATCH_POINTS, CONE_EDGES, 3)
    ).reshape(-1, 3)
    arms = np.repeat(corners.reshape(-1, 3), CONE_EDGES, axis=0)
    weight = mass * np.asarray(gravity, np.float64)
    size = max(float(np.linalg.norm(centres, axis=1).max()), 0.01)
    per_contact = PATCH_POINTS * CONE_EDGES
    # In units of the weight and of the grasp's size, so that tolerances mean the same everywhere.
    unit = max(float(np.linalg.norm(weight)), 1e-9)
    balance = np.concatenate([edges.T, np.cross(arms, edges).T / size])
    wanted = np.concatenate([-weight / unit, np.zeros(3)])
    # Whether any forces do, however large, is told ten times faster: most tests end here.
    if nnls(balance, wanted)[1] > 1e-6:
        return FeasibilityResult(feasible=False, normal_forces=np.full(count, np.nan))
    limits = {}
    if largest_force is not None:
        limits = {
            "A_ub": np.kron(np.eye(count), np.ones(per_contact)),
            "b_ub": np.full(count, largest_force / unit),
        }
    found = linprog(np.ones(len(edges)), A_eq=balance, b_eq=wanted, method="highs", **limits)
    if not found.success:
        return FeasibilityResult(feasible=False, normal_forces=np.full(count, np.nan))
    forces = unit * found.x.reshape(count, per_contact).sum(1)
    return FeasibilityResult(feasible=True, normal_forces=forces)
