"""The contact force program as the thesis writes it: coefficients of the friction pyramids' edges.

Solved as a least distance problem with non-negative least squares (Lawson and Hanson 1974, chapter
23), so that neither the unknowns nor the solver are those of the package.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from handtrack.grasp.contact_forces import ForceConfig

Float = NDArray[np.float64]


def edges_of(normal: Float, friction: float, count: int) -> Float:
    """Edges of one friction pyramid with a normal part of one, shape (3, count)."""
    first = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    angles = 2.0 * np.pi * np.arange(count) / count
    around = np.outer(first, np.cos(angles)) + np.outer(second, np.sin(angles))
    return normal[:, None] + friction * around


def objective(
    points: Float, normals: Float, wrench: Float, forces: Float, twists: Float, config: ForceConfig
) -> float:
    """Eq. III.23's sum, lengths in the size of the grasp."""
    size = max(float(np.linalg.norm(points, axis=1).mean()), 0.01)
    force = forces.sum(0) - wrench[:3]
    torque = (np.cross(points, forces) + twists[:, None] * normals).sum(0) - wrench[3:]
    return (
        config.force_weight * float(force @ force)
        + config.torque_weight * float(torque @ torque) / size**2
        + config.effort_weight * float((forces**2).sum())
        + config.torsion_weight * float((twists**2).sum()) / size**2
    )


def solve_by_edges(
    points: Float, normals: Float, wrench: Float, friction: float, least: Float, config: ForceConfig
) -> tuple[Float, Float]:
    """Forces, shape (npatch, 3), and torsional torques, shape (npatch,), of the least objective."""
    count, edges = len(points), config.cone_edges
    size = max(float(np.linalg.norm(points, axis=1).mean()), 0.01)
    basis = [edges_of(normal, config.friction_share * friction, edges) for normal in normals]
    width = count * (edges + 1)  # each patch: its edges' coefficients, then torsion over the size
    wanted, effort, limits, bounds = np.zeros((6, width)), [], [], []
    for k in range(count):
        own = slice(k * (edges + 1), (k + 1) * (edges + 1) - 1)
        wanted[:3, own] = basis[k]
        wanted[3:, own] = np.cross(points[k], basis[k].T).T / size
        wanted[3:, own.stop] = normals[k]
        part = np.zeros((4, width))
        part[:3, own] = np.sqrt(config.effort_weight) * basis[k]
        part[3, own.stop] = np.sqrt(config.torsion_weight)
        effort.append(part)
        press, twist = np.zeros(width), np.zeros(width)
        press[own], twist[own.stop] = 1.0, 1.0
        reach = config.torsion_radius / size
        limits += [press, -press, reach * press - twist, reach * press + twist, *np.eye(width)[own]]
        bounds += [least[k], -config.most_press, *np.zeros(2 + edges)]
    weight = np.sqrt(np.repeat([config.force_weight, config.torque_weight], 3))
    goal = weight * np.concatenate([wrench[:3], wrench[3:] / size])
    # Coefficients of one force are many; the shortest are taken.
    matrix = np.concatenate([weight[:, None] * wanted, *effort, 1e-6 * np.eye(width)])
    unknown = _least_squares(matrix, goal, np.array(limits), np.array(bounds))
    unknown = unknown.reshape(count, edges + 1)
    forces = np.stack([basis[k] @ unknown[k, :-1] for k in range(count)])
    return forces, size * unknown[:, -1]


def _least_squares(matrix: Float, goal: Float, limits: Float, bounds: Float) -> Float:
    """x of the least |matrix x - goal| with limits x >= bounds; the goal may end with zeros."""
    q, r = np.linalg.qr(matrix)
    shift = q[: len(goal)].T @ goal
    # y = r x - shift is to be as short as possible with turned y >= rest.
    turned = np.linalg.solve(r.T, limits.T).T
    rest = bounds - turned @ shift
    system = np.concatenate([turned.T, rest[None]])
    target = np.zeros(len(system))
    target[-1] = 1.0
    found, _ = nnls(system, target, maxiter=1000)
    residual = system @ found - target
    return np.linalg.solve(r, shift - residual[:-1] / residual[-1])
