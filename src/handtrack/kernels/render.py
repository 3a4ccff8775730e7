"""Depth rendering of the hand by a z-buffer: one triangle of one row per thread.

The buffer holds one 64-bit key per pixel, the bits of z (positive floats order like integers) above
the triangle's number, so one atomic minimum keeps the nearest surface and repeats exactly whatever
the order of threads.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False})

EMPTY = 0x7F800000_7FFFFFFF
"""Key of a pixel that no triangle covers: z = infinity."""


@wp.func
def _pack_key(z: float, item: int) -> wp.int64:
    return (wp.int64(wp.cast(z, wp.int32)) << wp.int64(32)) | wp.int64(item)


@wp.func
def key_depth(key: wp.int64) -> float:
    """Depth [m] held by a z-buffer key; infinity where nothing was drawn."""
    return wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)


@wp.func
def key_item(key: wp.int64) -> int:
    """Triangle held by a z-buffer key."""
    return wp.int32(key & wp.int64(0x7FFFFFFF))


def key_item_numpy(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles held by z-buffer keys on the host; meaningless where nothing was drawn."""
    return keys & 0x7FFFFFFF


@wp.kernel
def _clear_keys(
    # out
    keys_out: wp.array3d[wp.int64],
):
    """One pixel of one row: no surface."""
    rowid, y, x = wp.tid()
    keys_out[rowid, y, x] = wp.int64(EMPTY)


@wp.kernel
def _rasterize_triangles(
    # model
    faces_in: wp.array2d[int],
    row_hand_in: wp.array[int],
    # in
    cameras_in: wp.array2d[float],
    vertices_in: wp.array2d[wp.vec3],
    near: float,
    # out
    keys_io: wp.array3d[wp.int64],
):
    """One triangle of one row: z-test every pixel centre it covers."""
    rowid, faceid = wp.tid()
    hand = row_hand_in[rowid]
    a = vertices_in[rowid, faces_in[faceid, 0]]
    b = vertices_in[rowid, faces_in[faceid, 1]]
    c = vertices_in[rowid, faces_in[faceid, 2]]
    if wp.min(a[2], wp.min(b[2], c[2])) < near:
        return
    fx = cameras_in[hand, 0]
    fy = cameras_in[hand, 1]
    cx = cameras_in[hand, 2]
    cy = cameras_in[hand, 3]
    ax = fx * a[0] / a[2] + cx
    ay = fy * a[1] / a[2] + cy
    bx = fx * b[0] / b[2] + cx
    by = fy * b[1] / b[2] + cy
    cx_ = fx * c[0] / c[2] + cx
    cy_ = fy * c[1] / c[2] + cy
    area = (bx - ax) * (cy_ - ay) - (by - ay) * (cx_ - ax)
    # Outward counter-clockwise faces appear clockwise in y-down pixels when they face the camera.
    if area >= 0.0 or not wp.isfinite(area):
        return
    width = keys_io.shape[2]
    height = keys_io.shape[1]
    left = wp.max(int(wp.ceil(wp.clamp(wp.min(ax, wp.min(bx, cx_)), -1.0, float(width)))), 0)
    right = wp.min(
        int(wp.floor(wp.clamp(wp.max(ax, wp.max(bx, cx_)), -1.0, float(width)))), width - 1
    )
    top = wp.max(int(wp.ceil(wp.clamp(wp.min(ay, wp.min(by, cy_)), -1.0, float(height)))), 0)
    bottom = wp.min(
        int(wp.floor(wp.clamp(wp.max(ay, wp.max(by, cy_)), -1.0, float(height)))), height - 1
    )
    if left > right or top > bottom:
        return
    inverse = 1.0 / area
    # 1/z is affine in the image: two slopes and a start per triangle.
    ia = 1.0 / a[2]
    ib = 1.0 / b[2]
    ic = 1.0 / c[2]
    for y in range(top, bottom + 1):
        py = float(y)
        for x in range(left, right + 1):
            px = float(x)
            wa = ((bx - px) * (cy_ - py) - (by - py) * (cx_ - px)) * inverse
            wb = ((cx_ - px) * (ay - py) - (cy_ - py) * (ax - px)) * inverse
            wc = 1.0 - wa - wb
            if wa >= -1.0e-5 and wb >= -1.0e-5 and wc >= -1.0e-5:
                z = 1.0 / (wa * ia + wb * ib + wc * ic)
                wp.atomic_min(keys_io, rowid, y, x, _pack_key(z, faceid))


@wp.kernel
def _unpack_depth(
    # in
    keys_in: wp.array3d[wp.int64],
    # out
    depth_out: wp.array3d[float],
):
    """One pixel of one row: depth, 0 where nothing was drawn."""
    rowid, y, x = wp.tid()
    key = keys_in[rowid, y, x]
    depth_out[rowid, y, x] = wp.where(key == wp.int64(EMPTY), 0.0, key_depth(key))


def render_keys(
    faces: wp.array,
    row_hand: wp.array,
    cameras: wp.array,
    vertices: wp.array,
    *,
    keys: wp.array,
    near: float = 0.02,
    clear: bool = True,
) -> None:
    """Draw every row's mesh into its z-buffer.

    Args:
        faces: Triangles, outward counter-clockwise, shape (nface, 3).
        row_hand: Camera (and hand) of each row, shape (nrow,).
        cameras: fx, fy, cx, cy in pixels of the buffer, shape (nhand, >= 4).
        vertices: Vertices [m], camera frame, shape (nrow, nvert) vec3.
        keys: In and out: z-buffer, shape (nrow, height, width) int64.
        near: Triangles that reach nearer than this are dropped [m].
        clear: Start from an empty buffer.
    """
    if clear:
        wp.launch(_clear_keys, dim=keys.shape, inputs=[], outputs=[keys], device=keys.device)
    wp.launch(
        _rasterize_triangles,
        dim=(vertices.shape[0], faces.shape[0]),
        inputs=[faces, row_hand, cameras, vertices, near],
        outputs=[keys],
        device=keys.device,
    )


def unpack_depth(keys: wp.array, *, depth: wp.array) -> None:
    """Depth images [m], 0 = nothing drawn, of z-buffers; both of shape (nrow, height, width)."""
    wp.launch(_unpack_depth, dim=keys.shape, inputs=[keys], outputs=[depth], device=keys.device)
