"""Fit poses to one depth image per hand: batched Gauss-Newton ICP over all rows (thesis II.5.2).

One captured graph per frame. On the CPU, where Warp runs a launch on one core, rows are split over
two threads, each replaying its own graph.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.device import FrameGraph, resolve_device
from handtrack.errors import InputError
from handtrack.fitting.config import FitConfig
from handtrack.fitting.spheres import CollisionSpheres
from handtrack.fitting.uncertainty import FitInformation
from handtrack.fitting.workspace import HandArrays, RowArrays, point_directions
from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import NANGLE, NQ, NV
from handtrack.kernels import (
    correspond,
    crop,
    kinematics,
    priors,
    render,
    residuals,
    score,
    skinning,
    solve,
)
from handtrack.priors.gaussian import GaussianPrior

SQUARE_METRE = 1.0e4
"""Squared centimetres in a squared metre: weights are per cm^2, kernels work in metres."""


class Fitter:
    """Refines poses of one or several hands, several hypotheses each, against depth images.

    Use: `load_depth` and `place` per frame, `set_poses`, `run`, then read `poses`, `errors`.
    """

    def __init__(
        self,
        hands: Sequence[ShapedHand],
        camera: Camera,
        *,
        config: FitConfig | None = None,
        nhyp: int = 1,
        device: str | None = None,
        prior: GaussianPrior | None = None,
        graph: bool = True,
        threads: int | None = None,
    ) -> None:
        """Allocate everything for a fixed number of hands and hypotheses.

        Args:
            hands: One shaped hand per depth image, all of one side.
            camera: Camera of the depth images.
            config: Settings.
            nhyp: Hypotheses (rows) per hand.
            device: "cpu", "cuda:N" or None for the best there is.
            prior: Distribution of joint angles, needed when `config.prior_weight` > 0.
            graph: False launches eagerly, for debugging.
            threads: Host threads on the CPU; None takes one per core, at most one per row.

        Raises:
            InputError: The prior is missing, there is no hand or hypothesis, or the hands are not
                all of one side and mesh.
        """
        self.config = config if config is not None else FitConfig()
        if not hands or nhyp < 1:
            raise InputError(f"got {len(hands)} hands and {nhyp} hypotheses; expected at least one")
        if len({(hand.side, hand.nvert) for hand in hands}) > 1:
            raise InputError(
                "hands differ in side or mesh; make one Fitter for the right and one for the left"
            )
        if self.config.prior_weight > 0 and prior is None:
            raise InputError("prior_weight > 0 needs a GaussianPrior; pass prior=")
        self.device = resolve_device(device)
        self.camera, self.nhand, self.nhyp, self.nrow = camera, len(hands), nhyp, len(hands) * nhyp
        self.hand = DeviceHand.upload(hands, self.device)
        self.spheres = CollisionSpheres.build(hands, self.device)
        self.image = HandArrays.allocate(
            self.nhand, camera.height, camera.width, self.config, self.device
        )
        self.image.intrinsics.assign(np.array([camera.fx, camera.fy, camera.cx, camera.cy], "f4"))
        self.rows = RowArrays.allocate(
            self.nhand, nhyp, hands[0].nvert, self.spheres.count, self.config, self.device
        )
        self._prior_mean = wp.zeros(NANGLE, dtype=float, device=self.device)
        self._prior_precision = wp.zeros((NANGLE, NANGLE), dtype=float, device=self.device)
        if prior is not None:
            self._prior_mean.assign(prior.mean.astype(np.float32))
            self._prior_precision.assign(prior.precision.astype(np.float32))
        self._floors = wp.array(self._unknown_weights(
            self.config.translation_floor, self.config.angle_floor
        ), dtype=float, device=self.device)  # fmt: skip
        self.set_smoothness(self.config.smooth_weight)
        self._splits = self._split_rows(threads)
        self._prepare = FrameGraph(self._launch_prepare, self.device, graph=graph)
        self._refine = [
            FrameGraph(lambda part=part: self._launch_refine(part), self.device, graph=graph)
            for part in self._splits
        ]
        self._pool = ThreadPoolExecutor(len(self._splits)) if len(self._splits) > 1 else None

    def _split_rows(self, threads: int | None) -> list[RowArrays]:
        if threads is None:
            threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        parts = 1 if self.device.is_cuda else max(1, min(threads, self.nrow))
        edges = np.linspace(0, self.nrow, parts + 1).round().astype(int)
        return [self.rows.part(int(a), int(b)) for a, b in pairwise(edges)]

    @staticmethod
    def _unknown_weights(translation: float, angle: float) -> NDArray[np.float32]:
        weights = np.full(NV, angle, np.float32)
        weights[:3] = translation * SQUARE_METRE
        return weights

    def set_smoothness(self, weight: float) -> None:
        """Weight of staying near the reference pose (lambda_2), for all hands."""
        self._smooth = self._unknown_weights(weight, weight)
        self.image.smooth.assign(np.tile(self._smooth, (self.nhand, 1)))

    def resize(self, hands: Sequence[ShapedHand]) -> None:
        """Go on with hands of other shapes, one per depth image."""
        self.hand.resize(hands)
        self.spheres.resize(hands)

    def load_depth(self, depth: ArrayLike) -> None:
        """Copy depth images [m], shape (nhand, height, width) or (height, width), to the device.

        Raises:
            InputError: The images have another shape.
        """
        depth = _shaped("depth", depth, self.image.depth.shape, np.float32)
        _put(self.image.depth, depth)

    def place(self, centres: ArrayLike) -> None:
        """Lay each hand's crop and gate around where the hand is expected.

        Args:
            centres: Expected middle of each hand [m], camera frame, shape (nhand, 3).
        """
        centres = _shaped("centres", centres, (self.nhand, 3), np.float64)
        camera, config = self.camera, self.config
        crops = crop.crop_parameters(
            (camera.fx, camera.fy, camera.cx, camera.cy), centres,
            cells=config.crop_cells, span=config.crop_span,
        )  # fmt: skip
        gates = np.column_stack([centres, np.full(self.nhand, config.gate_radius)])
        _put(self.image.crops, crops)
        _put(self.image.gates, gates.astype(np.float32))
        _put(self.image.render_cameras, crops[:, :4] / np.float32(config.score_scale))

    def set_poses(self, poses: ArrayLike, references: ArrayLike | None = None) -> None:
        """Start poses of all rows, and the poses that smoothness pulls to (the same when None).

        Args:
            poses: Shape (nrow, 28).
            references: Shape (nrow, 28).
        """
        poses = _shaped("poses", poses, (self.nrow, NQ), np.float32)
        if references is None:
            references = poses
        references = _shaped("references", references, (self.nrow, NQ), np.float32)
        _put(self.rows.pose, poses)
        _put(self.rows.reference, references)

    def warm_up(self) -> None:
        """Compile the kernels and capture the graphs, on an empty image."""
        pose = np.zeros(NQ)
        pose[2], pose[3] = 0.5, 1.0
        self.load_depth(np.zeros(self.image.depth.shape, np.float32))
        self.place(np.tile(pose[:3], (self.nhand, 1)))
        self.set_poses(np.tile(pose, (self.nrow, 1)))
        self.run()

    def run(self) -> None:
        """Refine all rows against the loaded images and score them."""
        self._prepare()
        self.replay(self._refine)

    @property
    def parts(self) -> list[RowArrays]:
        """The rows as they are split over host threads."""
        return self._splits

    def replay(self, graphs: Sequence[FrameGraph]) -> None:
        """Run one graph per part of the rows, side by side once all are captured."""
        if self._pool is not None and all(graph.replays for graph in graphs):
            list(self._pool.map(FrameGraph.__call__, graphs))
        else:
            # Warp captures one graph at a time.
            for graph in graphs:
                graph()
        wp.synchronize_device(self.device)

    def launch_linearisation(self, rows: RowArrays, robust_scale: float | None = None) -> None:
        """Residuals and normal equations of a part at its poses, without a step.

        Public for fits of more than the pose; `run` must have seen the images.

        Args:
            rows: The part.
            robust_scale: Scale of the robust weights [m]; that of the last step without.
        """
        self._launch_pose(rows)
        self._launch_match(rows)
        self._launch_residuals(
            rows, self.config.robust_scale if robust_scale is None else robust_scale
        )
        self._launch_system(rows)

    @property
    def poses(self) -> NDArray[np.float32]:
        """Refined poses, shape (nrow, 28); a copy."""
        return np.array(self.rows.pose.numpy(), np.float32)

    @property
    def errors(self) -> NDArray[np.float32]:
        """Depth error E_d of each row [m] (Eq. II.19), shape (nrow,); a copy."""
        return np.array(self.rows.errors.numpy(), np.float32)

    def information(self, row: int) -> FitInformation:
        """What a row's last Gauss-Newton step knew, for `keypoint_deviation`; copies.

        Args:
            row: The row, such as the one of the lowest error.
        """
        rows, config = self.rows, self.config
        kept = rows.best_hessian if config.levenberg else rows.hessian
        hessian = kept.numpy()[row].astype(np.float64)
        # Staying near the last pose is a wish, not something that was seen.
        hessian[np.diag_indices(NV)] -= self._smooth
        depth = max(float(rows.pose.numpy()[row, 2]), 0.0)
        cell = max(config.crop_span / config.crop_cells, depth / self.camera.fx)
        return FitInformation(
            hessian=hessian / (SQUARE_METRE * (config.point_weight or 1.0)),
            unexplained=float(rows.errors.numpy()[row]) / config.score_cap,
            area=float(rows.counts.numpy()[row]) * (config.score_scale * cell) ** 2,
            spacing=config.point_stride * cell,
        )

    def _launch_prepare(self) -> None:
        image, config = self.image, self.config
        crop.crop_depth(
            image.depth, image.intrinsics, image.crops, image.gates,
            same_surface=config.same_surface, cells=image.cells, points=image.points,
        )  # fmt: skip
        crop.scan_columns(image.cells, nearest=image.nearest)
        if config.normal_reach > 0:
            crop.estimate_normals(
                image.cells, image.points, reach=config.normal_reach,
                max_step=config.same_surface,
                normals=image.point_normals,
            )  # fmt: skip

    def _launch_refine(self, rows: RowArrays) -> None:
        config = self.config
        rows.damping.fill_(config.damping)
        if config.levenberg:
            # What is kept before the first step: the start itself, with nothing to step along.
            wp.copy(rows.best_pose, rows.pose)
            rows.best_hessian.zero_()
            rows.best_gradient.zero_()
            rows.best_totals.fill_(float("inf"))
        for robust_scale in config.robust_scales():
            self.launch_linearisation(rows, robust_scale)
            self._launch_step(rows)
        if config.levenberg:
            # Judge the last step too, and hand back the best pose.
            self.launch_linearisation(rows)
            self._launch_judgement(rows)
            wp.copy(rows.pose, rows.best_pose)
        self._launch_pose(rows)
        self._launch_score(rows)

    def _launch_pose(self, rows: RowArrays) -> None:
        hand = self.hand
        kinematics.pose_bones(
            hand.bone_rotations, hand.bone_origins, hand.bone_parents, hand.bone_angles,
            hand.angle_axes, rows.row_hand, rows.pose,
            rotations=rows.rotations, origins=rows.origins, axes=rows.axes,
        )  # fmt: skip
        skinning.skin_vertices(
            hand.weight_bones, hand.weights, hand.local_vertices, hand.local_normals,
            rows.row_hand, rows.rotations, rows.origins,
            vertices=rows.vertices, normals=rows.normals,
        )  # fmt: skip

    def _launch_match(self, rows: RowArrays) -> None:
        image, config = self.image, self.config
        nbin = config.crop_cells // config.bin_cells
        correspond.bin_vertices(
            rows.row_hand, image.crops, rows.vertices, rows.normals,
            bin_size=config.bin_cells, nbin=nbin, heads=rows.heads, following=rows.following,
        )  # fmt: skip
        correspond.match_points(
            rows.row_hand, image.crops, image.cells, image.points, image.point_normals,
            rows.vertices, rows.normals, rows.heads, rows.following, rows.rotations, rows.origins,
            stride=config.point_stride, bin_size=config.bin_cells, nbin=nbin,
            window=config.search_window, max_distance=config.max_distance,
            min_cosine=config.min_cosine, wrist_x=config.wrist_cut, matches=rows.matches,
        )  # fmt: skip

    def _launch_residuals(self, rows: RowArrays, robust_scale: float) -> None:
        hand, image, config = self.hand, self.image, self.config
        directions = point_directions(config)
        residuals.point_rows(
            hand.weight_bones, hand.weights, hand.local_vertices, hand.vertex_chains,
            hand.angle_bones, rows.row_hand, image.points, rows.matches, rows.vertices,
            rows.normals, rows.rotations, rows.origins, rows.axes,
            stride=config.point_stride, directions=directions,
            tangent_weight=config.tangent_weight, weight=config.point_weight * SQUARE_METRE,
            robust_scale=robust_scale, max_distance=config.max_distance,
            palm_only=config.palm_only, rows=rows.rows, residuals=rows.residuals,
            chains=rows.chains, costs=rows.costs,
        )  # fmt: skip
        if config.silhouette_weight > 0 or config.front_weight > 0:
            npoint = rows.matches.shape[1]
            residuals.silhouette_rows(
                hand.weight_bones, hand.weights, hand.local_vertices, hand.vertex_chains,
                hand.vertex_is_hand, hand.angle_bones, rows.row_hand, image.crops, image.cells,
                image.nearest, rows.vertices, rows.normals, rows.rotations, rows.origins,
                rows.axes, first_slot=npoint * directions, first_cost=npoint,
                reach=config.silhouette_reach,
                silhouette_weight=config.silhouette_weight * SQUARE_METRE,
                silhouette_scale=config.silhouette_scale,
                silhouette_margin=config.silhouette_margin,
                front_weight=config.front_weight * SQUARE_METRE,
                front_scale=config.front_scale, front_margin=config.front_margin,
                rows=rows.rows, residuals=rows.residuals, chains=rows.chains, costs=rows.costs,
            )  # fmt: skip

    def _launch_system(self, rows: RowArrays) -> None:
        hand, config = self.hand, self.config
        solve.accumulate_normal_equations(
            rows.rows, rows.residuals, rows.chains, chain_hessians=rows.chain_hessians,
            chain_gradients=rows.chain_gradients, hessian=rows.hessian, gradient=rows.gradient,
        )  # fmt: skip
        first_cost = rows.matches.shape[1] + rows.vertices.shape[1]
        priors.add_pose_terms(
            hand.limits, self._prior_mean, self._prior_precision, rows.row_hand,
            rows.pose, rows.reference, self.image.smooth,
            limit_weight=config.limit_weight, prior_weight=config.prior_weight,
            first_cost=first_cost, hessian=rows.hessian, gradient=rows.gradient, costs=rows.costs,
        )  # fmt: skip
        if config.collision_weight > 0:
            spheres = self.spheres
            priors.add_collisions(
                spheres.bones, spheres.centres, spheres.radii, spheres.pairs, hand.angle_bones,
                rows.row_hand, rows.rotations, rows.origins, rows.axes,
                weight=config.collision_weight * SQUARE_METRE, cost_slot=first_cost + NV,
                centres=rows.sphere_centres,
                hessian=rows.hessian, gradient=rows.gradient, costs=rows.costs,
            )  # fmt: skip

    def _launch_judgement(self, rows: RowArrays) -> None:
        solve.sum_costs(rows.costs, totals=rows.totals)
        solve.judge_step(
            rows.totals, rows.pose, rows.hessian, rows.gradient,
            shrink=0.5, grow=4.0, least=1e-4, most=1e3, best_totals=rows.best_totals,
            damping=rows.damping, best_pose=rows.best_pose, best_hessian=rows.best_hessian,
            best_gradient=rows.best_gradient,
        )  # fmt: skip

    def _launch_step(self, rows: RowArrays) -> None:
        config = self.config
        start, hessian, gradient = rows.pose, rows.hessian, rows.gradient
        if config.levenberg:
            self._launch_judgement(rows)
            start, hessian, gradient = rows.best_pose, rows.best_hessian, rows.best_gradient
        solve.solve_step(
            hessian, gradient, rows.damping, self._floors, start,
            max_translation=config.max_translation, max_rotation=config.max_rotation,
            max_angle=config.max_angle, system=rows.system, step=rows.step, pose=rows.pose,
        )  # fmt: skip

    def _launch_score(self, rows: RowArrays) -> None:
        config = self.config
        render.render_keys(
            self.hand.faces, rows.row_hand, self.image.render_cameras, rows.vertices,
            keys=rows.keys,
        )  # fmt: skip
        score.score_depth(
            rows.row_hand, rows.keys, self.image.cells, self.image.points,
            rows.rotations, rows.origins, scale=config.score_scale, cap=config.score_cap,
            wrist_x=config.wrist_cut, errors=rows.errors, counts=rows.counts,
        )  # fmt: skip


def _put(array: wp.array, values: NDArray[np.float32]) -> None:
    """Copy host values of the array's shape into it."""
    if isinstance(array.device, wp.Device) and array.device.is_cpu:
        # The array's own memory; `assign` would wrap and copy through a temporary one.
        np.copyto(array.numpy(), values)
    else:
        array.assign(values)


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...], dtype: type) -> NDArray:
    """Values as a contiguous array of a shape; a leading 1 may be left out."""
    array = np.ascontiguousarray(values, dtype)
    if array.shape != shape and not (shape[0] == 1 and array.shape == shape[1:]):
        raise InputError(f"{name} have shape {array.shape}; expected {shape}")
    return array.reshape(shape)
