"""Contact forces that move an object as its reference moves: the quadratic program of Eq. III.23.

Unknowns are the coefficients of each patch's friction pyramid and its torsional torque. On top of
the thesis, each patch presses with a least force and the pyramid is narrower than friction allows,
so that the forces that are asked for lie inside what the contact can hold; lengths are measured in
the size of the grasp, so that forces and torques weigh alike.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

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


def pyramid(normals: Float, friction: float, edges: int) -> Float:
    """Edges of friction pyramids, each with a normal part of one, shape (npatch, 3, edges).

    Args:
        normals: Unit normals into the object, shape (npatch, 3).
        friction: Friction coefficient.
        edges: Number of edges.
    """
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angles = 2.0 * np.pi * np.arange(edges) / edges
    sideways = (
        np.cos(angles) * first[:, :, None] + np.sin(angles) * second[:, :, None]
    )  # (npatch, 3, edges)
    return normals[:, :, None] + friction * sideways


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
    count, edges = len(points), config.cone_edges
    if count == 0:
        return np.zeros((0, 3)), np.zeros(0)
    basis = pyramid(normals, config.friction_share * friction, edges)
    size = max(float(np.linalg.norm(points, axis=1).mean()), 0.01)
    nlambda = count * edges
    # Wrench of every coefficient, shape (6, count * edges + count), torques in units of the size.
    effect = np.zeros((6, nlambda + count))
    flat = np.moveaxis(basis, 0, 1).reshape(3, nlambda)
    effect[:3, :nlambda] = flat
    effect[3:, :nlambda] = np.cross(np.repeat(points, edges, 0), flat.T).T / size
    effect[3:, nlambda:] = normals.T  # unknowns l_k / size, in newtons like the rest
    goal = np.concatenate([wrench[:3], wrench[3:] / size])
    weight = np.repeat([config.force_weight, config.torque_weight], 3)
    hessian = effect.T @ (weight[:, None] * effect)
    for k in range(count):
        own = slice(k * edges, (k + 1) * edges)
        hessian[own, own] += config.effort_weight * basis[k].T @ basis[k]
    diagonal = np.arange(nlambda + count)
    hessian[diagonal[nlambda:], diagonal[nlambda:]] += config.torsion_weight
    hessian[diagonal, diagonal] += 1e-8
    linear = -effect.T @ (weight * goal)
    # Rows: normal force of each patch, then |torsion| <= radius * normal force as two rows.
    press = np.zeros((count, nlambda + count))
    press[np.repeat(np.arange(count), edges), np.arange(nlambda)] = 1.0
    twist = np.zeros_like(press)
    twist[np.arange(count), nlambda + np.arange(count)] = 1.0
    radius = config.torsion_radius / size
    rows = np.concatenate([press, twist - radius * press, twist + radius * press])
    least = config.least_press if least_press is None else least_press
    least = np.broadcast_to(np.asarray(least, np.float64), count)
    if (least > config.most_press).any():
        raise InputError(f"least_press is {least.max()}; expected at most {config.most_press}")
    free, nothing = np.full(count, 1e30), np.zeros(count)
    lower = np.concatenate([np.zeros(nlambda), -free, least, -free, nothing])
    upper = np.concatenate(
        [np.full(nlambda, 1e30), free, np.full(count, config.most_press), nothing, free]
    )
    daqp = import_extra("daqp", "physics", "solving for contact forces")
    found, _, flag, _ = daqp.solve(hessian, linear, rows, upper, lower)
    if flag < 1:
        # A solution exists, pressing straight with the least force; the solver gave up on rounding.
        _LOG.warning("contact forces were not solved for (DAQP flag %d): pressing straight", flag)
        return least[:, None] * normals, nothing
    forces = np.einsum("kie,ke->ki", basis, found[:nlambda].reshape(count, edges))
    return forces, size * found[nlambda:]
