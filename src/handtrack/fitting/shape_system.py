"""Normal equations of the shape that several images share, with their poses eliminated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from handtrack.device import FrameGraph
from handtrack.fitting.fitter import Fitter
from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.fitting.workspace import RowArrays, point_directions
from handtrack.hand.skeleton import FINGERS, NV
from handtrack.kernels.residuals import NLOCAL
from handtrack.kernels.shape_rows import PARTS, accumulate_shape, shape_rows

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeEquations:
    """Gauss-Newton equations of every row: of its pose, of the shape, and between them."""

    poses: Float
    """J_p^T J_p with the terms of the pose alone, shape (nrow, 27, 27)."""
    pose_gradients: Float
    """J_p^T r, shape (nrow, 27)."""
    shapes: Float
    """J_s^T J_s, shape (nrow, nshape, nshape)."""
    shape_gradients: Float
    """J_s^T r, shape (nrow, nshape)."""
    mixed: Float
    """J_s^T J_p, shape (nrow, nshape, 27)."""

    def reduced(self, floor: Float) -> tuple[Float, Float]:
        """What each row tells of the shape when its pose follows: Schur complements.

        Args:
            floor: Added to the diagonal of the pose's system, shape (27,).

        Returns:
            Matrices, shape (nrow, nshape, nshape), and gradients, shape (nrow, nshape).
        """
        answers = self._answers(floor)
        matrices = self.shapes - answers @ np.swapaxes(self.mixed, 1, 2)
        gradients = self.shape_gradients - np.einsum("rsp,rp->rs", answers, self.pose_gradients)
        return matrices, gradients

    def pose_steps(self, floor: Float, step: Float) -> Float:
        """Increments of the poses that go with a step of the shape, shape (nrow, 27)."""
        system = self.poses + np.diag(floor)
        right = self.pose_gradients + np.einsum("rsp,s->rp", self.mixed, step)
        return -np.linalg.solve(system, right[..., None])[..., 0]

    def _answers(self, floor: Float) -> Float:
        """J_s^T J_p (J_p^T J_p)^-1, shape (nrow, nshape, 27)."""
        system = self.poses + np.diag(floor)
        answers = np.linalg.solve(system, np.swapaxes(self.mixed, 1, 2))
        return np.asarray(np.swapaxes(answers, 1, 2), np.float64)


class ShapeSystem:
    """Builds the equations of all rows of a fitter, on its device."""

    def __init__(self, fitter: Fitter, unknowns: ShapeUnknowns, *, graph: bool = True) -> None:
        """Allocate.

        Args:
            fitter: One row per image; its hands are of the same shape.
            unknowns: The unknowns of that shape.
            graph: False launches eagerly, for debugging.
        """
        self._fitter, self._unknowns = fitter, unknowns
        device, count = fitter.device, unknowns.count
        nvert, nbone = fitter.rows.vertices.shape[1], fitter.rows.origins.shape[1]
        nslot = fitter.rows.chains.shape[1]
        self._vertex_steps = wp.zeros((nvert, 3, count), dtype=wp.vec3, device=device)
        self._joint_steps = wp.zeros((nbone, count), dtype=wp.vec3, device=device)
        columns = count + 1 + len(FINGERS) * NLOCAL

        def make(*shape: int, dtype: type = float) -> Any:
            return wp.zeros((fitter.nrow, *shape), dtype=dtype, device=device)

        self._origin_steps = make(nbone, count, dtype=wp.vec3)
        self._rows = make(nslot, count)
        self._sums = make(PARTS, count, columns)
        self._products = make(count, columns)
        self._graphs, first = [], 0
        for part in fitter.parts:
            own = slice(first, first + part.pose.shape[0])
            first = own.stop
            self._graphs.append(FrameGraph(
                lambda part=part, own=own: self._launch(part, own), device, graph=graph
            ))  # fmt: skip

    def build(self, x: Float) -> ShapeEquations:
        """Equations at the fitter's poses and images.

        Args:
            x: Unknowns of the shape that the fitter's hands have, shape (nshape,).
        """
        steps = self._unknowns.steps(x)
        self._vertex_steps.assign(steps.vertices.astype(np.float32))
        self._joint_steps.assign(steps.joints.astype(np.float32))
        self._fitter.replay(self._graphs)
        rows, count = self._fitter.rows, self._unknowns.count
        products = self._products.numpy().astype(np.float64)
        lower = np.tril(products[:, :, :count])
        mixed = np.zeros((len(products), count, NV))
        fingers = products[:, :, count + 1 :].reshape(*mixed.shape[:2], len(FINGERS), NLOCAL)
        mixed[..., :6] = fingers[..., :6].sum(axis=2)
        mixed[..., 6:11] = fingers[..., 0, 6:]
        mixed[..., 11:] = fingers[..., 1:, 6:10].reshape(*mixed.shape[:2], -1)
        return ShapeEquations(
            poses=rows.hessian.numpy().astype(np.float64),
            pose_gradients=rows.gradient.numpy().astype(np.float64),
            shapes=lower + np.swapaxes(np.tril(lower, -1), 1, 2),
            shape_gradients=products[:, :, count],
            mixed=mixed,
        )

    def _launch(self, rows: RowArrays, own: slice) -> None:
        hand = self._fitter.hand
        self._fitter.launch_linearisation(rows)
        shape_rows(
            hand.bone_parents, hand.weight_bones, hand.weights, self._joint_steps,
            self._vertex_steps, rows.rotations, rows.matches, rows.rows, rows.chains,
            directions=point_directions(self._fitter.config),
            origin_steps=self._origin_steps[own], shape_rows=self._rows[own],
        )  # fmt: skip
        accumulate_shape(
            self._rows[own], rows.rows, rows.residuals, rows.chains, sums=self._sums[own],
            products=self._products[own],
        )  # fmt: skip
