"""Depth error between rendered and observed depth (Eq. II.19)."""

from __future__ import annotations

import warp as wp

from handtrack.kernels.render import EMPTY, key_depth

wp.set_module_options({"enable_backward": False})

LANES = 64


@wp.func
def _error_sums(
    keys_in: wp.array3d[wp.int64],
    cells_in: wp.array3d[float],
    points_in: wp.array3d[wp.vec3],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    rowid: int,
    hand: int,
    scale: int,
    cap: float,
    wrist_x: float,
    first: int,
    step: int,
):
    # Sum of the capped differences and number of pixels of the union, over every step-th pixel.
    n = keys_in.shape[2]
    total = float(0.0)
    count = int(0)
    rotation = wp.transpose(rotations_in[rowid, 0])
    origin = origins_in[rowid, 0]
    cell = first
    while cell < n * n:
        y = cell // n
        x = cell % n
        key = keys_in[rowid, y, x]
        drawn = key != wp.int64(EMPTY)
        seen = cells_in[hand, y * scale, x * scale]
        # Unknown cells say nothing; points behind the wrist are the forearm, drawn or not.
        if wp.isfinite(seen):
            is_hand = drawn
            if seen > 0.0:
                palm = rotation @ (points_in[hand, y * scale, x * scale] - origin)
                is_hand = palm[0] >= wrist_x
            if is_hand:
                difference = float(cap)
                if drawn and seen > 0.0:
                    difference = wp.min(wp.abs(key_depth(key) - seen), cap)
                total += difference
                count += 1
        cell += step
    return total, count


@wp.kernel
def _score_depth(
    # in
    row_hand_in: wp.array[int],
    keys_in: wp.array3d[wp.int64],
    cells_in: wp.array3d[float],
    points_in: wp.array3d[wp.vec3],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    scale: int,
    cap: float,
    wrist_x: float,
    # out
    errors_out: wp.array[float],
    counts_out: wp.array[int],
):
    """One row: mean capped depth difference over the union of rendered and observed hand pixels."""
    rowid = wp.tid()
    total, count = _error_sums(
        keys_in, cells_in, points_in, rotations_in, origins_in, rowid, row_hand_in[rowid],
        scale, cap, wrist_x, 0, 1,
    )  # fmt: skip
    counts_out[rowid] = count
    errors_out[rowid] = wp.where(count > 0, total / float(wp.max(count, 1)), cap)


@wp.kernel
def _score_depth_tiled(
    # in
    row_hand_in: wp.array[int],
    keys_in: wp.array3d[wp.int64],
    cells_in: wp.array3d[float],
    points_in: wp.array3d[wp.vec3],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    scale: int,
    cap: float,
    wrist_x: float,
    # out
    errors_out: wp.array[float],
    counts_out: wp.array[int],
):
    """One row, a block of threads each: the same, lanes summed in a fixed order."""
    rowid, lane = wp.tid()
    total, count = _error_sums(
        keys_in, cells_in, points_in, rotations_in, origins_in, rowid, row_hand_in[rowid],
        scale, cap, wrist_x, lane, wp.block_dim(),
    )  # fmt: skip
    totals = wp.tile_sum(wp.tile(total))
    counts = wp.tile_sum(wp.tile(count))
    if lane == 0:
        counts_out[rowid] = counts[0]
        errors_out[rowid] = wp.where(counts[0] > 0, totals[0] / float(wp.max(counts[0], 1)), cap)


def score_depth(
    row_hand: wp.array,
    keys: wp.array,
    cells: wp.array,
    points: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    scale: int,
    cap: float,
    wrist_x: float,
    errors: wp.array,
    counts: wp.array,
) -> None:
    """Depth error E_d of every row (Eq. II.19), each pixel's difference capped.

    Args:
        row_hand: Hand of each row, shape (nrow,).
        keys: Z-buffers of the rendered hands, shape (nrow, m, m) int64.
        cells: Depth cells, shape (nhand, m * scale, m * scale).
        points: Observed points [m], shape of `cells` vec3.
        rotations: R_camera_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        scale: Cells per rendered pixel, along each side.
        cap: Largest difference counted for one pixel [m].
        wrist_x: Observed points behind this palm-frame x belong to the forearm [m].
        errors: Out: E_d [m], shape (nrow,).
        counts: Out: pixels of the union, shape (nrow,).
    """
    inputs = [row_hand, keys, cells, points, rotations, origins, scale, cap, wrist_x]
    if errors.device.is_cuda:
        wp.launch_tiled(
            _score_depth_tiled,
            dim=errors.shape,
            inputs=inputs,
            outputs=[errors, counts],
            block_dim=LANES,
            device=errors.device,
        )
    else:
        # Tiles on the CPU share one static buffer, which two host threads would both write.
        wp.launch(
            _score_depth,
            dim=errors.shape,
            inputs=inputs,
            outputs=[errors, counts],
            device=errors.device,
        )
