"""Hands of the shipped model, scanned by the virtual scanner: nothing else is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.learning import virtual_scanner
from handtrack.hand.learning.posed_template import Template
from handtrack.hand.learning.scans import Scan
from handtrack.hand.learning.weights import dense_weights, slot_weights
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.hand.surface_distance import surface_distance
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix


@dataclass(frozen=True)
class Scanned:
    """One scan and what it was made from."""

    mesh: trimesh.Trimesh
    pose: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    arm: NDArray[np.bool_]

    def scan(self, subject: str = "a") -> Scan:
        return Scan.of_mesh(self.mesh, subject=subject, pose=self.pose)

    def away(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances of a hand's vertices, arm apart, from the surface that was scanned [m]."""
        return surface_distance(vertices[~self.arm], self.vertices, self.faces)


@pytest.fixture(scope="session")
def model() -> HandModel:
    return HandModel.load()


@pytest.fixture(scope="session")
def template(model: HandModel) -> Template:
    return Template.of(model)


@pytest.fixture(scope="session")
def open_faces(model: HandModel) -> NDArray[np.int32]:
    """The skin without the cap that closes the forearm."""
    return virtual_scanner.open_faces(model)


@pytest.fixture(scope="session")
def poses(model: HandModel) -> dict[str, NDArray[np.float64]]:
    """Two poses that bend all joints by different amounts."""
    flexes = np.abs(model.dof_axes[:, 2]) > 0.5
    bent = np.where(flexes, np.radians(38.0), 0.0)
    bent[:5] = model.rest_angles[:5] + np.radians([10.0, 0.0, 12.0, 0.0, 15.0])
    return {"rest": model.rest_angles, "bent": np.clip(bent, *model.limits.T)}


@pytest.fixture(scope="session")
def blurred(model: HandModel) -> HandModel:
    """The model with weights that three rounds of averaging have spoilt."""
    dense = dense_weights(model.weight_bones, model.weights)
    beside = np.eye(len(dense), dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        beside[model.faces[:, a], model.faces[:, b]] = True
    share = (beside | beside.T) / (beside | beside.T).sum(axis=1, keepdims=True)
    for _ in range(3):
        dense = share @ dense
    # Of two fingers only the stronger one and the palm remain, as in every hand model.
    chains = dense[:, 1:].reshape(-1, 5, 3)
    strongest = chains.sum(axis=2).argmax(axis=1)
    chains[np.arange(5) != strongest[:, None]] = 0.0
    chains[chains < 1e-3] = 0.0
    dense[:, 0] = 1.0 - chains.sum(axis=(1, 2))
    dense[:, 1:] = chains.reshape(-1, 15)
    bones, weights = slot_weights(dense)
    return replace(model, weight_bones=bones, weights=weights)


@pytest.fixture(scope="session")
def scan_of(
    model: HandModel,
    template: Template,
    open_faces: NDArray[np.int32],
    poses: dict[str, NDArray[np.float64]],
) -> Callable[[HandShape, str, int], Scanned]:
    """Scan of a shape in a pose that is met to some degrees, from anywhere."""

    def make(shape: HandShape, pose: str, seed: int) -> Scanned:
        rng = np.random.default_rng(seed)
        angles = poses[pose] + np.radians(3.0) * rng.standard_normal(21)
        turn = matrix_to_quat(rotvec_to_matrix(2.0 * rng.standard_normal(3)))
        place = rng.standard_normal(3)
        full = np.concatenate([place, turn, np.clip(angles, *model.limits.T)])
        vertices = skin(model.shaped(shape), full)
        mesh = virtual_scanner.virtual_scan(vertices, open_faces, rng)
        return Scanned(mesh, pose, vertices, open_faces, template.stub)

    return make
