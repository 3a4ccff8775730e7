"""Everything the fit writes, allocated once: per hand (depth image) and per row (hypothesis)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from handtrack.fitting.config import FitConfig
from handtrack.hand.skeleton import FINGERS, NANGLE, NBONE, NQ, NV
from handtrack.kernels.crop import CROP_SIZE, GATE_SIZE
from handtrack.kernels.residuals import vec11
from handtrack.kernels.solve import mat11


@dataclass(slots=True, kw_only=True)
class HandArrays:
    """Arrays with one entry per hand: the depth image and what is made of it once per frame."""

    depth: wp.array
    intrinsics: wp.array
    crops: wp.array
    gates: wp.array
    smooth: wp.array
    render_cameras: wp.array
    cells: wp.array
    points: wp.array
    point_normals: wp.array
    nearest: wp.array

    @classmethod
    def allocate(
        cls, nhand: int, height: int, width: int, config: FitConfig, device: wp.Device
    ) -> HandArrays:
        """Allocate for `nhand` images of one size."""
        n = config.crop_cells

        def make(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        return cls(
            depth=make(nhand, height, width),
            intrinsics=make(4),
            crops=make(nhand, CROP_SIZE),
            gates=make(nhand, GATE_SIZE),
            smooth=make(nhand, NV),
            render_cameras=make(nhand, 4),
            cells=make(nhand, n, n),
            points=make(nhand, n, n, dtype=wp.vec3),
            point_normals=make(nhand, n, n, dtype=wp.vec3),
            nearest=make(nhand, n, n, dtype=int),
        )


@dataclass(slots=True, kw_only=True)
class RowArrays:
    """Arrays with one entry per row; `part` gives a view on some of the rows."""

    row_hand: wp.array
    pose: wp.array
    reference: wp.array
    rotations: wp.array
    origins: wp.array
    axes: wp.array
    vertices: wp.array
    normals: wp.array
    heads: wp.array
    following: wp.array
    matches: wp.array
    rows: wp.array
    residuals: wp.array
    chains: wp.array
    costs: wp.array
    totals: wp.array
    chain_hessians: wp.array
    chain_gradients: wp.array
    hessian: wp.array
    gradient: wp.array
    best_totals: wp.array
    best_pose: wp.array
    best_hessian: wp.array
    best_gradient: wp.array
    damping: wp.array
    system: wp.array
    step: wp.array
    sphere_centres: wp.array
    keys: wp.array
    errors: wp.array
    counts: wp.array

    @classmethod
    def allocate(
        cls, nhand: int, nhyp: int, nvert: int, nsphere: int, config: FitConfig, device: wp.Device
    ) -> RowArrays:
        """Allocate `nhyp` hypotheses of each of `nhand` hands; row = hand * nhyp + hypothesis."""
        nrow = nhand * nhyp
        nbin = config.crop_cells // config.bin_cells
        npoint = (config.crop_cells // config.point_stride) ** 2
        pixels = config.crop_cells // config.score_scale
        # One residual slot per point and direction, then one per vertex.
        nslot = npoint * point_directions(config) + nvert
        # Costs: points, vertices, the 27 unknowns' terms, collisions.
        ncost = npoint + nvert + NV + 1

        def make(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        rows = cls(
            row_hand=make(nrow, dtype=int),
            pose=make(nrow, NQ),
            reference=make(nrow, NQ),
            rotations=make(nrow, NBONE, dtype=wp.mat33),
            origins=make(nrow, NBONE, dtype=wp.vec3),
            axes=make(nrow, NANGLE, dtype=wp.vec3),
            vertices=make(nrow, nvert, dtype=wp.vec3),
            normals=make(nrow, nvert, dtype=wp.vec3),
            heads=make(nrow, nbin * nbin, dtype=int),
            following=make(nrow, nvert, dtype=int),
            matches=make(nrow, npoint, dtype=int),
            rows=make(nrow, nslot, dtype=vec11),
            residuals=make(nrow, nslot),
            chains=make(nrow, nslot, dtype=int),
            costs=make(nrow, ncost),
            totals=make(nrow),
            chain_hessians=make(nrow, len(FINGERS), dtype=mat11),
            chain_gradients=make(nrow, len(FINGERS), dtype=vec11),
            hessian=make(nrow, NV, NV),
            gradient=make(nrow, NV),
            best_totals=make(nrow),
            best_pose=make(nrow, NQ),
            best_hessian=make(nrow, NV, NV),
            best_gradient=make(nrow, NV),
            damping=make(nrow),
            system=make(nrow, NV, NV),
            step=make(nrow, NV),
            sphere_centres=make(nrow, nsphere, dtype=wp.vec3),
            keys=make(nrow, pixels, pixels, dtype=wp.int64),
            errors=make(nrow),
            counts=make(nrow, dtype=int),
        )
        rows.row_hand.assign(np.repeat(np.arange(nhand), nhyp).astype(np.int32))
        rows.chains.fill_(-2)
        return rows

    def part(self, start: int, stop: int) -> RowArrays:
        """Views on rows start to stop."""
        return RowArrays(**{f.name: getattr(self, f.name)[start:stop] for f in fields(self)})


def point_directions(config: FitConfig) -> int:
    """Residuals per point: the plane distance, and two tangential ones when they have weight."""
    return 3 if config.tangent_weight > 0 else 1
