"""Contact forces that move an object as its reference moves: the quadratic program of Eq. III.23.

The thesis solves for coefficients of each friction pyramid's edges. Here the unknowns are the force
along each patch's normal and two tangents, and its torsional torque; the facets of the same pyramid
are constraints. That is the same optimum, with four unknowns a patch in place of seven and with
constraints that never change. On top of the thesis, each patch presses with a least force and the
pyramid is narrower than friction allows, so that the forces that are asked for lie inside what the
contact can hold; lengths are measured in the size of the grasp, so that forces and torques weigh
alike.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.optional import import_extra

Float = NDArray[np.float64]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceConfig:
    """Weights and limits of Eq. III.23."""

    force_weight: float = 1.0
    """alpha_1: missing the wanted force."""
    torque_weight: float = 1.0
    """alpha_2: missing the wanted torque, divided by the grasp's size squared."""
    effort_weight: float = 0.001
    """alpha_3: size of the contact forces. The thesis has 0.1, which leaves a tenth of the weight
    to gravity."""
    torsion_weight: float = 0.001
    """alpha_4: size of the torsional torques, likewise."""
    friction_share: float = 0.6
    """Share of the friction that is planned with."""
    torsion_radius: float = 0.004
    """Torsional torque per normal force at most [m]."""
    cone_edges: int = 6
    """Edges of the friction pyramid."""
    least_press: float = 0.5
    """Least normal force of a patch [N]."""
    most_press: float = 20.0
    """Largest normal force of a patch [N]: a fingertip's strength."""

    def __post_init__(self) -> None:
        if self.cone_edges < 3:
            raise InputError(f"cone_edges is {self.cone_edges}; expected at least 3")
        if not 0.0 <= self.least_press < self.most_press:
            raise InputError(
                f"least_press is {self.least_press} and most_press {self.most_press}; expected "
                "the first to be smaller"
            )
        if not 0.0 < self.friction_share <= 1.0:
            raise InputError(f"friction_share is {self.friction_share}; expected within (0, 1]")
        if not self.torsion_radius >= 0.0:
            raise InputError(f"torsion_radius is {self.torsion_radius}; expected at least 0")


def _frame(x: float, y: float, z: float) -> tuple[float, ...]:
    """Two tangents to a unit normal, at right angles to each other, one after the other.

    In plain numbers, like the loop of `_wrenches`: for a grasp's few patches NumPy takes longer.
    """
    if abs(x) < 0.9:  # the first tangent is at right angles to the x axis
        r = max(math.sqrt(y * y + z * z), 1e-9)
        return 0.0, z / r, -y / r, -r, x * y / r, x * z / r
    r = math.sqrt(x * x + z * z)
    return -z / r, 0.0, x / r, x * y / r, -r, y * z / r


def pyramid(normals: Float, friction: float, edges: int) -> Float:
    """Edges of friction pyramids, each with a normal part of one, shape (npatch, 3, edges).

    Args:
        normals: Unit normals into the object, shape (npatch, 3).
        friction: Friction coefficient.
        edges: Number of edges.
    """
    tangents = np.array([_frame(*normal) for normal in normals.tolist()]).reshape(-1, 2, 3, 1)
    angles = 2.0 * np.pi * np.arange(edges) / edges
    sideways = np.cos(angles) * tangents[:, 0] + np.sin(angles) * tangents[:, 1]
    return normals[:, :, None] + friction * sideways


@dataclass(frozen=True, slots=True)
class _Limits:
    """What is the same in every program with a number of patches; shared, so never written to."""

    rows: Float
    """Constraints, patch by patch: its press, facets and torsion, shape (nrow, 4 * npatch)."""
    senses: NDArray[np.intc]
    """DAQP's kinds of the constraints: inequalities all, shape (nrow,)."""
    lower: Float
    """Lower bounds, shape (npatch, nrow / npatch); the least press is put first."""
    upper: Float
    """Upper bounds, shape (nrow,)."""
    effort: Float
    """Weights of the forces themselves; torsion's is to be added, shape (4 * npatch,)."""


@lru_cache(maxsize=64)
def _limits(config: ForceConfig, friction: float, count: int) -> _Limits:
    """Limits of `count` patches whose forces keep within a pyramid of some friction."""
    edges = config.cone_edges
    # A facet lies midway between two edges, and nearer to the normal than they do.
    middles = (2.0 * np.arange(edges) + 1.0) * np.pi / edges
    rows = np.zeros((1 + edges + 2, 4))
    rows[:, 0] = 1.0, *[-friction * np.cos(np.pi / edges)] * edges, -1.0, -1.0
    rows[1:-2, 1], rows[1:-2, 2] = np.cos(middles), np.sin(middles)
    rows[-2:, 3] = 1.0, -1.0
    upper = np.zeros((count, len(rows)))
    upper[:, 0] = config.most_press
    effort = config.effort_weight * np.array([1.0, 1.0, 1.0, 0.0])
    return _Limits(
        rows=np.asarray(np.kron(np.eye(count), rows), np.float64),
        senses=np.zeros(upper.size, np.intc),
        lower=np.full(upper.shape, -1e30),
        upper=upper.ravel(),
        # A little more keeps the program definite where a weight or the torsion radius is zero.
        effort=np.tile(effort + 1e-8, count),
    )


@cache
def _solver() -> Callable[..., Any]:
    return import_extra("daqp", "physics", "solving for contact forces").solve


def _wrenches(points: list[list[float]], normals: list[list[float]], radius: float) -> Float:
    """Force and torque of a patch's four unknowns, patch by patch, shape (4 * npatch, 6).

    Args:
        points: Centre of each patch.
        normals: Its unit normal.
        radius: Torsional torque by one of the last unknown.
    """
    rows: list[float] = []
    for (px, py, pz), (x, y, z) in zip(points, normals, strict=True):
        ax, ay, az, bx, by, bz = _frame(x, y, z)
        rows += (
            x, y, z, py * z - pz * y, pz * x - px * z, px * y - py * x,
            ax, ay, az, py * az - pz * ay, pz * ax - px * az, px * ay - py * ax,
            bx, by, bz, py * bz - pz * by, pz * bx - px * bz, px * by - py * bx,
            0.0, 0.0, 0.0, radius * x, radius * y, radius * z,
        )  # fmt: skip
    return np.array(rows, np.float64).reshape(-1, 6)


def contact_forces(
    points: Float,
    normals: Float,
    wrench: Float,
    *,
    friction: float,
    least_press: ArrayLike | None = None,
    config: ForceConfig,
) -> tuple[Float, Float]:
    """Forces and torsional torques of the hand on the object that come nearest to a wrench.

    Args:
        points: Centres of the patches from the object's centre of mass [m], shape (npatch, 3).
        normals: Unit normals into the object, shape (npatch, 3).
        wrench: Wanted force [N] and torque about the centre of mass [N m], shape (6,).
        friction: The object's friction.
        least_press: Least normal forces [N], shape (npatch,) or one; None takes the
            configuration's.
        config: Weights and limits.

    Returns:
        Forces on the object [N], shape (npatch, 3), and torques about the normals [N m], (npatch,).

    Raises:
        InputError: The least normal force is over the largest.
        MissingDependencyError: DAQP is not installed.
    """
    count = len(points)
    if count == 0:
        return np.zeros((0, 3)), np.zeros(0)
    limits = _limits(config, config.friction_share * friction, count)
    lower = limits.lower.copy()
    lower[:, 0] = config.least_press if least_press is None else least_press
    if max(lower[:, 0].tolist()) > config.most_press:
        raise InputError(
            f"least_press is {lower[:, 0].max()}; expected at most {config.most_press}"
        )
    radius, places = config.torsion_radius, points.tolist()
    size = max(sum([math.hypot(x, y, z) for x, y, z in places]) / count, 0.01)
    # Torsional torques are solved for in newtons too: over the radius, so that the patch's normal
    # force is their bound.
    wrenches = _wrenches(places, normals.tolist(), radius)
    weight = np.array([config.force_weight] * 3 + [config.torque_weight / size**2] * 3)
    effect = wrenches * weight
    hessian = np.dot(effect, wrenches.T)
    diagonal = hessian.ravel()[:: 4 * count + 1]
    diagonal += limits.effort
    diagonal[3::4] += config.torsion_weight * (radius / size) ** 2
    found, _, flag, _ = _solver()(
        hessian, np.dot(effect, -wrench), limits.rows, limits.upper, lower.ravel(), limits.senses
    )
    if flag < 1:
        # A solution exists, pressing straight with the least force; the solver gave up on rounding.
        _LOG.warning("contact forces were not solved for (DAQP flag %d): pressing straight", flag)
        return lower[:, :1] * normals, np.zeros(count)
    found = found.reshape(count, 1, 4)
    forces = np.matmul(found, wrenches.reshape(count, 4, 6)[:, :, :3])
    return forces[:, 0], radius * found[:, 0, 3]
