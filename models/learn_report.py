"""What learning from scans is worth, measured on scans whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import trimesh
from hand_builder.weights import smoothed, sparse_weights
from learn_scans import Truth
from numpy.typing import NDArray

from handtrack.evaluation.curves import draw_curves
from handtrack.hand.learning import LearntHand, Scan, ScanFile, read_scan
from handtrack.hand.learning import posed_template as posing
from handtrack.hand.learning.space_fit import fit_in_space
from handtrack.hand.learning.subject import start_subject
from handtrack.hand.learning.virtual_scanner import open_faces
from handtrack.hand.learning.weights import dense_weights, mean_weight_error
from handtrack.hand.model import HandModel
from handtrack.hand.surface_distance import surface_distance

Float = NDArray[np.float64]

Scans = Mapping[str, Sequence[ScanFile]]

REST = "rest"
"""Name of the template's own pose."""


def blurred(model: HandModel, rounds: int) -> HandModel:
    """The model with weights averaged with their neighbours: what learning starts from."""
    dense = dense_weights(model.weight_bones, model.weights)
    bones, weights = sparse_weights(smoothed(dense, model.faces, rounds))
    return replace(model, weight_bones=bones, weights=weights)


def weight_errors(models: Mapping[str, HandModel], truth: Truth) -> dict[str, float]:
    """Summed absolute difference from the true weights, mean over the vertices, by model."""
    right = dense_weights(truth.weight_bones, truth.weights)
    return {
        name: mean_weight_error(dense_weights(m.weight_bones, m.weights), right)
        for name, m in models.items()
    }


class SurfaceErrors:
    """Collects how far fitted hands are from the true surfaces, arm apart."""

    def __init__(self, model: HandModel, truth: Truth) -> None:
        self._true = dict(zip(truth.names, truth.vertices, strict=True))
        self._faces = open_faces(model)
        self._hand = ~posing.Template.of(model).stub
        self._rows: list[tuple[float, float, float]] = []

    def add(self, file: ScanFile, vertices: Float) -> None:
        """Compare one fitted hand with the surface that the scan was made from."""
        true = self._true[file.path.name]
        away = surface_distance(vertices[self._hand], true, self._faces)
        same = np.linalg.norm((vertices - true)[self._hand], axis=1)
        self._rows.append((away.mean(), np.quantile(away, 0.95), same.mean()))

    def summary(self) -> dict[str, float]:
        """Millimetres: means over scans, and the worst scan."""
        rows = 1e3 * np.array(self._rows)
        mean, p95, same = rows.mean(axis=0).round(3).tolist()
        worst, median = rows[:, 0].max(), np.median(rows[:, 0])
        return {
            "surface_mean_mm": mean,
            "surface_median_scan_mm": round(float(median), 3),
            "surface_worst_scan_mm": round(float(worst), 3),
            "surface_p95_mm": p95,
            "vertex_mean_mm": same,
            "scans": len(rows),
        }


def fitted_errors(learnt: LearntHand, scans: Scans, truth: Truth) -> dict[str, float]:
    """Errors of the subjects that were learnt from, with their own scales and offsets."""
    template = posing.Template.of(learnt.model)
    errors = SurfaceErrors(learnt.model, truth)
    for name, fit in learnt.subjects.items():
        posed = posing.PosedTemplate(template, fit.shape, fit.poses)
        for file, vertices in zip(scans[name], posed.vertices, strict=True):
            errors.add(file, vertices)
    return errors.summary()


def astray_scans(learnt: LearntHand, scans: Scans) -> list[str]:
    """Scans that learning itself found badly met."""
    return [
        file.path.name
        for name, fit in learnt.subjects.items()
        for file, lost in zip(scans[name], fit.astray, strict=True)
        if lost
    ]


def unseen_errors(
    model: HandModel,
    scans: Scans,
    poses: Mapping[str, Float],
    truth: Truth,
    *,
    free_shape: bool = True,
) -> dict[str, float]:
    """Errors of subjects that a model has not seen, with alpha, beta and poses only."""
    template = posing.Template.of(model)
    errors = SurfaceErrors(model, truth)
    for files in scans.values():
        read = [read_scan(file) for file in files]
        asked = np.array([poses[file.pose] for file in files])
        start = start_subject(template, read, asked)
        found = fit_in_space(model, read, start.poses, free_shape=free_shape)
        for file, vertices in zip(files, found.vertices, strict=True):
            errors.add(file, vertices)
    return errors.summary()


def registered_scan(vertices: Float, model: HandModel, *, subject: str) -> Scan:
    """A scan at rest whose vertices are those of a model's template [m], shape (nvert, 3)."""
    mesh = trimesh.Trimesh(vertices, model.faces, process=False)
    return Scan.of_mesh(mesh, subject=subject, pose=REST, template_faces=model.faces)


def explained_shares(
    models: Mapping[str, HandModel], meshes: Sequence[Float]
) -> dict[str, dict[str, float]]:
    """How much of the shape of unseen people each model's space explains.

    Args:
        models: Models of one topology.
        meshes: Vertices of people that none of the spaces was learnt from, at rest [m], each of
            shape (nvert, 3).

    Returns:
        By model: share of the squared distances from the mean hand that alpha and beta take away,
        joint angles being free for both, and the mean distance that is left [mm].
    """
    shares = {}
    for name, model in models.items():
        template = posing.Template.of(model)
        total = left = distance = 0.0
        for vertices in meshes:
            scans = [registered_scan(vertices, model, subject=name)]
            start = start_subject(template, scans, model.rest_angles[None])
            near, mean = (
                fit_in_space(model, scans, start.poses, steps=8, free_shape=free).vertices[0]
                for free in (True, False)
            )
            left += float(((near - vertices) ** 2).sum())
            total += float(((mean - vertices) ** 2).sum())
            distance += float(np.linalg.norm(near - vertices, axis=1).mean())
        shares[name] = {
            "explained": round(1.0 - left / total, 4),
            "left_mm": round(1e3 * distance / len(meshes), 3),
        }
    return shares


def residual_picture(runs: Mapping[str, LearntHand]) -> NDArray[np.uint8]:
    """Residual by step of several runs, a gap wherever the rounds meet."""
    curves = {}
    for name, learnt in runs.items():
        steps, values, at = [], [], 0
        for residuals in learnt.residuals:
            steps += [*range(at, at + len(residuals)), at + len(residuals)]
            values += [*(1e3 * np.array(residuals)), np.nan]
            at += len(residuals)
        curves[name] = (np.array(steps, float), np.array(values))
    return draw_curves(
        curves,
        "step; a gap is a change of the weights and of the population's mean",
        "mean distance from matches [mm]",
        "Learning from scans: residual by step",
        y_range=(0.0, 1.0),
    )
