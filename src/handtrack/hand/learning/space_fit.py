"""One subject fitted with a shape space alone: what it is worth for people outside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.learning.correspondence import ScanSurface
from handtrack.hand.learning.posed_template import PosedTemplate, SubjectShape, Template
from handtrack.hand.learning.scans import Scan
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.hand.skeleton import NV
from handtrack.transforms import apply_increment

Float = NDArray[np.float64]

_DATA_STD = 0.0005
"""Distance of a vertex from its match [m]."""
_ANGLE_STD = 1.0
"""Departure from the start of an angle [rad]; settles what a scan leaves open."""
_LONGEST_STEP = 0.35
"""Largest turn of the palm or of a joint in one step [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceFit:
    """A subject in a shape space."""

    shape: HandShape
    poses: Float
    """Shape (nscan, 28)."""
    vertices: Float
    """Vertices in the frames of the scans [m], shape (nscan, nvert, 3)."""


def fit_in_space(
    model: HandModel,
    scans: Sequence[Scan],
    poses: Float,
    *,
    steps: int = 20,
    reach: tuple[float, float] = (0.02, 0.006),
    free_shape: bool = True,
) -> SpaceFit:
    """Fit alpha, beta and poses to scans of one subject (Eq. II.11 on scans).

    Args:
        model: Hand model.
        scans: Scans of the subject.
        poses: First poses, shape (nscan, 28), such as `start_subject` gives.
        steps: Gauss-Newton steps.
        reach: Largest distance of a match [m] in the first and in the last step.
        free_shape: Fit the shape too; otherwise only poses are fitted, of the mean hand.

    Returns:
        The fit; alpha and beta are held near the mean by their unit variance.
    """
    template = Template.of(model)
    surfaces = [ScanSurface(scan) for scan in scans]
    ncoord = (model.nalpha + model.nbeta) if free_shape else 0
    coordinates = np.zeros(ncoord)
    first = poses.copy()
    for limit in np.geomspace(*reach, steps):
        shape = _subject_shape(model, coordinates)
        posed = PosedTemplate(template, shape, poses)
        normals = posed.normals
        by_pose = posed.by_pose()
        system = np.eye(ncoord + NV * len(poses)) * 1e-6
        slope = np.zeros(len(system))
        own = np.arange(ncoord)
        system[own, own] += 1.0
        slope[own] += coordinates
        by_shape = _by_coordinates(model, posed, coordinates)
        for index, surface in enumerate(surfaces):
            matches = surface.match(posed.vertices[index], normals[index], reach=float(limit))
            jacobian = np.concatenate([by_shape[index], by_pose[index]], axis=2)
            rows, away = matches.rows(jacobian, posed.vertices[index])
            columns = np.r_[0:ncoord, ncoord + NV * index : ncoord + NV * (index + 1)]
            system[np.ix_(columns, columns)] += rows.T @ rows / _DATA_STD**2
            slope[columns] += away @ rows / _DATA_STD**2
            at = columns[ncoord + 6 :]
            system[at, at] += 1.0 / _ANGLE_STD**2
            slope[at] += (poses[index, 7:] - first[index, 7:]) / _ANGLE_STD**2
        step = -np.linalg.solve(system, slope)
        moves = step[ncoord:].reshape(len(poses), NV)  # a view: shortened with the step
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(moves[:, 3:]).max()), 1e-12))
        coordinates = coordinates + step[:ncoord]
        poses = apply_increment(poses, moves)
    found = _hand_shape(model, coordinates)
    return SpaceFit(shape=found, poses=poses, vertices=skin(model.shaped(found), poses))


def _hand_shape(model: HandModel, coordinates: Float) -> HandShape:
    """Shape of alpha and beta; the mean hand of no coordinates."""
    alpha, beta = np.split(coordinates, [model.nalpha])
    return HandShape(alpha=alpha, beta=beta)


def _subject_shape(model: HandModel, coordinates: Float) -> SubjectShape:
    """Stretches and offsets of a point of the shape space."""
    shape = _hand_shape(model, coordinates)
    scales = model.scales(shape)
    offsets = model.offset_mean + model.offset_basis[..., : len(shape.beta)] @ shape.beta
    count = len(model.vertices)
    return SubjectShape(
        stretches=scales[0] * scales[1:], joints=offsets[count:], offsets=offsets[:count]
    )


def _by_coordinates(model: HandModel, posed: PosedTemplate, coordinates: Float) -> Float:
    """Derivative of the vertices by alpha and beta, shape (npose, nvert, 3, nalpha + nbeta)."""
    if not len(coordinates):
        return np.zeros((*posed.vertices.shape, 0))
    scales = model.scales(_hand_shape(model, coordinates))
    stretched = scales[0] * model.scale_basis[1:] + np.outer(scales[1:], model.scale_basis[0])
    count = len(model.vertices)
    joints = model.offset_basis[count:].reshape(15, -1)
    return np.concatenate(
        [
            posed.by_stretches() @ stretched,
            np.einsum("tvij,vjn->tvin", posed.by_offsets(), model.offset_basis[:count])
            + posed.by_joints() @ joints,
        ],
        axis=3,
    )
