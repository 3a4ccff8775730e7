"""Device maths shared by the kernels: w-first quaternions in plain arrays, rotations."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def pose_rotation(pose: wp.array2d[float], rowid: int) -> wp.mat33:
    """Rotation R_camera_palm of one row's pose."""
    w = pose[rowid, 3]
    x = pose[rowid, 4]
    y = pose[rowid, 5]
    z = pose[rowid, 6]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def pose_translation(pose: wp.array2d[float], rowid: int) -> wp.vec3:
    """Translation of one row's pose."""
    return wp.vec3(pose[rowid, 0], pose[rowid, 1], pose[rowid, 2])


@wp.func
def axis_rotation(axis: wp.vec3, angle: float) -> wp.mat33:
    """Rotation by an angle about a unit axis (Rodrigues)."""
    s = wp.sin(angle)
    c = 1.0 - wp.cos(angle)
    k = wp.skew(axis)
    return wp.identity(n=3, dtype=float) + s * k + c * (k @ k)


@wp.func
def quat_times_exp(q: wp.vec4, w: wp.vec3) -> wp.vec4:
    """Q * exp(w) for a w-first quaternion and a rotation vector, normalised."""
    angle = wp.length(w)
    half = 0.5 * angle
    # sin(a/2)/a by its series near zero, where the quotient loses digits.
    k = 0.5 - angle * angle / 48.0
    if angle > 1.0e-3:
        k = wp.sin(half) / angle
    c = wp.cos(half)
    v = k * w
    u = wp.vec3(q[1], q[2], q[3])
    real = q[0] * c - wp.dot(u, v)
    imag = q[0] * v + c * u + wp.cross(u, v)
    return wp.normalize(wp.vec4(real, imag[0], imag[1], imag[2]))
