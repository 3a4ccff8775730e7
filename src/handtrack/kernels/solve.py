"""Normal equations, damped Cholesky solve, accept or reject, pose update (Eq. II.27)."""

from __future__ import annotations

import warp as wp

from handtrack.kernels.residuals import NLOCAL, vec11
from handtrack.kernels.se3 import quat_times_exp

wp.set_module_options({"enable_backward": False})

mat11 = wp.types.matrix(shape=(NLOCAL, NLOCAL), dtype=float)

NV = 27
"""Unknowns of one row."""

LANES = 64
"""Threads per block of the tiled kernels, which run on CUDA only."""


@wp.kernel
def _accumulate_chains(
    # in
    rows_in: wp.array2d[vec11],
    residuals_in: wp.array2d[float],
    chains_in: wp.array2d[int],
    # out
    hessians_out: wp.array2d[mat11],
    gradients_out: wp.array2d[vec11],
):
    """One row: J^T J and J^T r of its five fingers in one pass over the residuals."""
    rowid = wp.tid()
    for chain in range(hessians_out.shape[1]):
        hessians_out[rowid, chain] = mat11()
        gradients_out[rowid, chain] = vec11()
    for slot in range(rows_in.shape[1]):
        chain = chains_in[rowid, slot]
        if chain >= 0:
            row = rows_in[rowid, slot]
            hessians_out[rowid, chain] = hessians_out[rowid, chain] + wp.outer(row, row)
            gradients_out[rowid, chain] = (
                gradients_out[rowid, chain] + residuals_in[rowid, slot] * row
            )


@wp.kernel
def _accumulate_chains_tiled(
    # in
    rows_in: wp.array2d[vec11],
    residuals_in: wp.array2d[float],
    chains_in: wp.array2d[int],
    # out
    hessians_out: wp.array2d[mat11],
    gradients_out: wp.array2d[vec11],
):
    """One finger of one row, a block each: J^T J and J^T r, lanes summed in a fixed order."""
    rowid, chain, lane = wp.tid()
    hessian = mat11()
    gradient = vec11()
    slot = lane
    while slot < rows_in.shape[1]:
        if chains_in[rowid, slot] == chain:
            row = rows_in[rowid, slot]
            hessian += wp.outer(row, row)
            gradient += residuals_in[rowid, slot] * row
        slot += wp.block_dim()
    hessian_sum = wp.tile_sum(wp.tile(hessian, preserve_type=True))
    gradient_sum = wp.tile_sum(wp.tile(gradient, preserve_type=True))
    if lane == 0:
        hessians_out[rowid, chain] = hessian_sum[0]
        gradients_out[rowid, chain] = gradient_sum[0]


@wp.kernel
def _sum_costs(
    # in
    costs_in: wp.array2d[float],
    # out
    totals_out: wp.array[float],
):
    """One row: sum of its costs."""
    rowid = wp.tid()
    total = float(0.0)
    for slot in range(costs_in.shape[1]):
        total += costs_in[rowid, slot]
    totals_out[rowid] = total


@wp.kernel
def _sum_costs_tiled(
    # in
    costs_in: wp.array2d[float],
    # out
    totals_out: wp.array[float],
):
    """One row, a block of threads each: sum of its costs, lanes summed in a fixed order."""
    rowid, lane = wp.tid()
    total = float(0.0)
    slot = lane
    while slot < costs_in.shape[1]:
        total += costs_in[rowid, slot]
        slot += wp.block_dim()
    sums = wp.tile_sum(wp.tile(total))
    if lane == 0:
        totals_out[rowid] = sums[0]


@wp.func
def _angle_chain(unknown: int) -> int:
    # Finger whose joint angle an unknown is; -1 for the palm's six.
    chain = int(-1)
    if unknown >= 6:
        chain = wp.where(unknown < 11, 0, (unknown - 7) // 4)
    return chain


@wp.func
def _angle_local(unknown: int) -> int:
    # Place of an unknown among the eleven of its finger.
    local = unknown
    if unknown >= 11:
        local = 6 + (unknown - 7) % 4
    return local


@wp.kernel
def _assemble_data(
    # in
    hessians_in: wp.array2d[mat11],
    gradients_in: wp.array2d[vec11],
    # out
    hessian_out: wp.array3d[float],
    gradient_out: wp.array2d[float],
):
    """One unknown of one row: its line of the 27 x 27 system from the five fingers' blocks."""
    rowid, i = wp.tid()
    chain = _angle_chain(i)
    local = _angle_local(i)
    g = float(0.0)
    for c in range(hessians_in.shape[1]):
        if chain < 0 or chain == c:
            g += gradients_in[rowid, c][local]
    gradient_out[rowid, i] = g
    for j in range(hessian_out.shape[2]):
        other = _angle_chain(j)
        other_local = _angle_local(j)
        h = float(0.0)
        for c in range(hessians_in.shape[1]):
            if (chain < 0 or chain == c) and (other < 0 or other == c):
                h += hessians_in[rowid, c][local, other_local]
        hessian_out[rowid, i, j] = h


@wp.kernel
def _judge_step(
    # in
    totals_in: wp.array[float],
    pose_in: wp.array2d[float],
    hessian_in: wp.array3d[float],
    gradient_in: wp.array2d[float],
    shrink: float,
    grow: float,
    least: float,
    most: float,
    # out
    best_totals_io: wp.array[float],
    damping_io: wp.array[float],
    best_pose_io: wp.array2d[float],
    best_hessian_io: wp.array3d[float],
    best_gradient_io: wp.array2d[float],
):
    """One row: keep the tried pose when its energy fell, else go back and damp more."""
    rowid = wp.tid()
    total = totals_in[rowid]
    if wp.isfinite(total) and total <= best_totals_io[rowid]:
        best_totals_io[rowid] = total
        damping_io[rowid] = wp.max(damping_io[rowid] * shrink, least)
        for k in range(pose_in.shape[1]):
            best_pose_io[rowid, k] = pose_in[rowid, k]
        for i in range(hessian_in.shape[1]):
            best_gradient_io[rowid, i] = gradient_in[rowid, i]
            for j in range(hessian_in.shape[2]):
                best_hessian_io[rowid, i, j] = hessian_in[rowid, i, j]
    else:
        damping_io[rowid] = wp.min(damping_io[rowid] * grow, most)


@wp.kernel
def _damp_system(
    # in
    hessian_in: wp.array3d[float],
    damping_in: wp.array[float],
    floors_in: wp.array[float],
    # out
    system_out: wp.array3d[float],
):
    """One entry of one row: H + lambda diag(H) + floor."""
    rowid, i, j = wp.tid()
    h = hessian_in[rowid, i, j]
    if i == j:
        h += damping_in[rowid] * h + floors_in[i]
    system_out[rowid, i, j] = h


@wp.kernel
def _solve_cholesky(
    # in
    gradient_in: wp.array2d[float],
    # out
    system_io: wp.array3d[float],
    step_io: wp.array2d[float],
):
    """One row: Cholesky in place, then forward and backward substitution."""
    rowid = wp.tid()
    for j in range(system_io.shape[1]):
        pivot = system_io[rowid, j, j]
        for k in range(j):
            pivot -= system_io[rowid, j, k] * system_io[rowid, j, k]
        # A negative pivot gives NaN, which the step's user answers by staying put.
        pivot = wp.sqrt(pivot)
        system_io[rowid, j, j] = pivot
        for i in range(j + 1, system_io.shape[1]):
            entry = system_io[rowid, i, j]
            for k in range(j):
                entry -= system_io[rowid, i, k] * system_io[rowid, j, k]
            system_io[rowid, i, j] = entry / pivot
    for i in range(system_io.shape[1]):
        value = gradient_in[rowid, i]
        for k in range(i):
            value -= system_io[rowid, i, k] * step_io[rowid, k]
        step_io[rowid, i] = value / system_io[rowid, i, i]
    for back in range(system_io.shape[1]):
        i = system_io.shape[1] - 1 - back
        value = step_io[rowid, i]
        for k in range(i + 1, system_io.shape[1]):
            value -= system_io[rowid, k, i] * step_io[rowid, k]
        step_io[rowid, i] = value / system_io[rowid, i, i]


@wp.kernel
def _solve_cholesky_tiled(
    # in
    system_in: wp.array3d[float],
    gradient_in: wp.array2d[float],
    # out
    step_out: wp.array2d[float],
):
    """One row, a block each: solve the symmetric positive definite system by Cholesky."""
    rowid, _lane = wp.tid()
    system = wp.tile_load(system_in[rowid], shape=(NV, NV))
    gradient = wp.tile_load(gradient_in[rowid], shape=NV)
    step = wp.tile_cholesky_solve(wp.tile_cholesky(system), gradient)
    wp.tile_store(step_out[rowid], step)


@wp.kernel
def _apply_step(
    # in
    start_in: wp.array2d[float],
    step_in: wp.array2d[float],
    max_translation: float,
    max_rotation: float,
    max_angle: float,
    # out
    pose_out: wp.array2d[float],
):
    """One row: pose minus the Newton step on the manifold, as a whole no longer than allowed."""
    rowid = wp.tid()
    largest = float(1.0)
    finite = bool(True)
    for i in range(NV):
        s = wp.abs(step_in[rowid, i])
        limit = max_angle
        if i < 3:
            limit = max_translation
        elif i < 6:
            limit = max_rotation
        largest = wp.max(largest, s / limit)
        finite = finite and wp.isfinite(s)
    # A singular system leaves the pose where it is.
    scale = wp.where(finite, -1.0 / largest, 0.0)
    for k in range(3):
        pose_out[rowid, k] = start_in[rowid, k] + wp.where(finite, scale * step_in[rowid, k], 0.0)
    w = wp.vec3(step_in[rowid, 3], step_in[rowid, 4], step_in[rowid, 5])
    if not finite:
        w = wp.vec3(0.0)
    q = wp.vec4(start_in[rowid, 3], start_in[rowid, 4], start_in[rowid, 5], start_in[rowid, 6])
    q = quat_times_exp(q, scale * w)
    for k in range(4):
        pose_out[rowid, 3 + k] = q[k]
    for k in range(6, NV):
        move = wp.where(finite, scale * step_in[rowid, k], 0.0)
        pose_out[rowid, 1 + k] = start_in[rowid, 1 + k] + move


def accumulate_normal_equations(
    rows: wp.array,
    residuals: wp.array,
    chains: wp.array,
    *,
    chain_hessians: wp.array,
    chain_gradients: wp.array,
    hessian: wp.array,
    gradient: wp.array,
) -> None:
    """J^T J and J^T r of every row from its compact Jacobian rows.

    Args:
        rows: Weighted Jacobian rows, shape (nrow, nslot) vec11.
        residuals: Weighted residuals, shape (nrow, nslot).
        chains: Finger of each residual, negative for none, shape (nrow, nslot).
        chain_hessians: Scratch, shape (nrow, 5) mat11.
        chain_gradients: Scratch, shape (nrow, 5) vec11.
        hessian: Out: J^T J, shape (nrow, 27, 27).
        gradient: Out: J^T r, shape (nrow, 27).
    """
    # Tiles on the CPU share one static buffer, which two host threads would both write.
    if rows.device.is_cuda:
        wp.launch_tiled(
            _accumulate_chains_tiled,
            dim=chain_hessians.shape,
            inputs=[rows, residuals, chains],
            outputs=[chain_hessians, chain_gradients],
            block_dim=LANES,
            device=rows.device,
        )
    else:
        wp.launch(
            _accumulate_chains,
            dim=chain_hessians.shape[0],
            inputs=[rows, residuals, chains],
            outputs=[chain_hessians, chain_gradients],
            device=rows.device,
        )
    wp.launch(
        _assemble_data,
        dim=gradient.shape,
        inputs=[chain_hessians, chain_gradients],
        outputs=[hessian, gradient],
        device=rows.device,
    )


def sum_costs(costs: wp.array, *, totals: wp.array) -> None:
    """Sum of each row of costs, shape (nrow, n), into totals, shape (nrow,)."""
    if costs.device.is_cuda:
        wp.launch_tiled(
            _sum_costs_tiled,
            dim=totals.shape,
            inputs=[costs],
            outputs=[totals],
            block_dim=LANES,
            device=costs.device,
        )
    else:
        wp.launch(
            _sum_costs,
            dim=totals.shape,
            inputs=[costs],
            outputs=[totals],
            device=costs.device,
        )


def judge_step(
    totals: wp.array,
    pose: wp.array,
    hessian: wp.array,
    gradient: wp.array,
    *,
    shrink: float,
    grow: float,
    least: float,
    most: float,
    best_totals: wp.array,
    damping: wp.array,
    best_pose: wp.array,
    best_hessian: wp.array,
    best_gradient: wp.array,
) -> None:
    """Levenberg's accept or reject: keep each row's lowest-energy pose and its linear system.

    Args:
        totals: Energy at the tried poses, shape (nrow,).
        pose: Tried poses, shape (nrow, 28).
        hessian: J^T J at the tried poses, shape (nrow, 27, 27).
        gradient: J^T r at the tried poses, shape (nrow, 27).
        shrink: Factor on the damping after an accepted step.
        grow: Factor on the damping after a rejected step.
        least: Lower bound of the damping.
        most: Upper bound of the damping.
        best_totals: In and out: lowest energy, infinity to begin with, shape (nrow,).
        damping: In and out: damping, shape (nrow,).
        best_pose: In and out: pose of the lowest energy, shape (nrow, 28).
        best_hessian: In and out: its J^T J, shape (nrow, 27, 27).
        best_gradient: In and out: its J^T r, shape (nrow, 27).
    """
    wp.launch(
        _judge_step,
        dim=totals.shape[0],
        inputs=[totals, pose, hessian, gradient, shrink, grow, least, most],
        outputs=[best_totals, damping, best_pose, best_hessian, best_gradient],
        device=pose.device,
    )


def solve_step(
    hessian: wp.array,
    gradient: wp.array,
    damping: wp.array,
    floors: wp.array,
    start: wp.array,
    *,
    max_translation: float,
    max_rotation: float,
    max_angle: float,
    system: wp.array,
    step: wp.array,
    pose: wp.array,
) -> None:
    """Solve (H + lambda diag H + floor) dq = -g and move the pose along dq.

    Args:
        hessian: J^T J, shape (nrow, 27, 27).
        gradient: J^T r, shape (nrow, 27).
        damping: lambda of each row, shape (nrow,).
        floors: Constant added to the diagonal, shape (27,).
        start: Poses to start from, shape (nrow, 28).
        max_translation: Longest translation per step and axis [m].
        max_rotation: Largest rotation per step and axis [rad].
        max_angle: Largest change of a joint angle per step [rad].
        system: Scratch: damped system, shape (nrow, 27, 27).
        step: Out: Newton step before shortening (pose moves by minus this), shape (nrow, 27).
        pose: Out: moved poses, shape (nrow, 28).
    """
    wp.launch(
        _damp_system,
        dim=system.shape,
        inputs=[hessian, damping, floors],
        outputs=[system],
        device=pose.device,
    )
    if pose.device.is_cuda:
        wp.launch_tiled(
            _solve_cholesky_tiled,
            dim=(pose.shape[0],),
            inputs=[system, gradient],
            outputs=[step],
            block_dim=LANES,
            device=pose.device,
        )
    else:
        wp.launch(
            _solve_cholesky,
            dim=pose.shape[0],
            inputs=[gradient],
            outputs=[system, step],
            device=pose.device,
        )
    wp.launch(
        _apply_step,
        dim=pose.shape[0],
        inputs=[start, step, max_translation, max_rotation, max_angle],
        outputs=[pose],
        device=pose.device,
    )
