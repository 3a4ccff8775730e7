"""Coordinates of the grasp motion model as hand poses about an object (Eq. III.1 to III.3).

A particle is one motion: weights of shape and time of its grip mode's model, then how the motion is
placed. A row is one frame of a particle. Arrays hold the models of several grip modes side by side,
filled up to the largest; `counts` says how many shape modes, time modes, reference frames and
mixture components each has.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from handtrack.kernels.se3 import quat_times_exp

wp.set_module_options({"enable_backward": False})

NPLACE = wp.constant(6)
"""Placement: yaw, offset in the grasp frame, two tilts; the last coordinates of a particle."""

vec27: Any = wp.types.vector(length=27, dtype=float)
"""Increment of a pose: place [m], rotation vector, and joint angles [rad]."""


@wp.struct
class Placing:
    """How particles are placed about an object."""

    upright: wp.vec4
    """Rotation from the frame that is upright in the world to the object's, w first."""
    offset_spread: float
    """Deviation of offsets [m]."""
    tilt_spread: float
    """Deviation of tilts [rad]."""


@wp.func
def _quat_product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    # Of w-first quaternions.
    u = wp.vec3(a[1], a[2], a[3])
    v = wp.vec3(b[1], b[2], b[3])
    imag = a[0] * v + b[0] * u + wp.cross(u, v)
    return wp.vec4(a[0] * b[0] - wp.dot(u, v), imag[0], imag[1], imag[2])


@wp.func
def _turned(q: wp.vec4, point: wp.vec3) -> wp.vec3:
    # By a w-first unit quaternion.
    u = wp.vec3(q[1], q[2], q[3])
    twice = 2.0 * wp.cross(u, point)
    return point + q[0] * twice + wp.cross(u, twice)


@wp.func
def _log_density(
    log_shares: wp.array2d[float],
    means: wp.array3d[float],
    whiteners: wp.array4d[float],
    positions: wp.array2d[float],
    grip: int,
    particleid: int,
    ncomponent: int,
    nweight: int,
) -> float:
    # ln pr(alpha, gamma) of the mixture, summed without leaving the range of floats.
    most = float(-1.0e30)
    total = float(0.0)
    for component in range(ncomponent):
        square = float(0.0)
        for row in range(nweight):
            white = float(0.0)
            for column in range(row + 1):
                off = positions[particleid, column] - means[grip, component, column]
                white += whiteners[grip, component, row, column] * off
            square += white * white
        term = log_shares[grip, component] - 0.5 * square
        if term > most:
            total = total * wp.exp(most - term) + 1.0
            most = term
        else:
            total += wp.exp(term - most)
    return most + wp.log(total)


@wp.kernel
def _decode_particles(
    # model
    counts_in: wp.array2d[int],
    bases_in: wp.array[wp.vec4],
    times_in: wp.array3d[float],
    log_shares_in: wp.array2d[float],
    means_in: wp.array3d[float],
    whiteners_in: wp.array4d[float],
    # in
    placings_in: wp.array[Placing],
    positions_in: wp.array2d[float],
    grips_in: wp.array[int],
    # out
    warps_out: wp.array2d[float],
    lows_out: wp.array2d[int],
    parts_out: wp.array2d[float],
    turns_out: wp.array[wp.vec4],
    shifts_out: wp.array[wp.vec3],
    bases_out: wp.array[wp.vec4],
    densities_out: wp.array[float],
):
    """One particle: its time warp, its placement, and the log density of its coordinates."""
    particleid = wp.tid()
    grip = grips_in[particleid]
    nshape = counts_in[grip, 0]
    ntime = counts_in[grip, 1]
    nref = counts_in[grip, 2]

    # The warp H(t; gamma), and for every wanted frame where it lies in the reference's time.
    warp = float(0.0)
    warps_out[particleid, 0] = 0.0
    for step in range(nref - 1):
        log_step = times_in[grip, step, 0]
        for mode in range(ntime):
            log_step += positions_in[particleid, nshape + mode] * times_in[grip, step, 1 + mode]
        warp += wp.exp(log_step)
        warps_out[particleid, step + 1] = warp
    nframe = lows_out.shape[0]
    low = nref - 2
    for frame in range(nframe):
        wanted = warp * float(nframe - 1 - frame) / float(nframe - 1)
        while low > 0 and warps_out[particleid, low] > wanted:
            low -= 1
        start = warps_out[particleid, low]
        lows_out[frame, particleid] = low
        parts_out[frame, particleid] = wp.clamp(
            (wanted - start) / (warps_out[particleid, low + 1] - start), 0.0, 1.0
        )

    first = positions_in.shape[1] - NPLACE
    yaw = positions_in[particleid, first]
    offset = wp.vec3(
        positions_in[particleid, first + 1],
        positions_in[particleid, first + 2],
        positions_in[particleid, first + 3],
    )
    tilt = wp.vec3(positions_in[particleid, first + 4], positions_in[particleid, first + 5], 0.0)
    placing = placings_in[0]
    turn = quat_times_exp(placing.upright, wp.vec3(0.0, 0.0, yaw))
    tilted = quat_times_exp(turn, tilt)
    turns_out[particleid] = tilted
    shifts_out[particleid] = _turned(turn, offset)
    bases_out[particleid] = _quat_product(tilted, bases_in[grip])

    density = _log_density(
        log_shares_in, means_in, whiteners_in, positions_in, grip, particleid, counts_in[grip, 3],
        nshape + ntime,
    )  # fmt: skip
    away = wp.length_sq(offset / placing.offset_spread)
    away += wp.length_sq(tilt / placing.tilt_spread)
    densities_out[particleid] = density - 0.5 * away


@wp.kernel
def _decode_rows(
    # model
    counts_in: wp.array2d[int],
    shapes_in: wp.array3d[vec27],
    # in
    row_hand_in: wp.array[int],
    positions_in: wp.array2d[float],
    grips_in: wp.array[int],
    lows_in: wp.array2d[int],
    parts_in: wp.array2d[float],
    turns_in: wp.array[wp.vec4],
    shifts_in: wp.array[wp.vec3],
    bases_in: wp.array[wp.vec4],
    # out
    pose_out: wp.array2d[float],
):
    """One row: the motion between two frames of the reference, placed about the object."""
    frame, particleid = wp.tid()
    rowid = frame * grips_in.shape[0] + particleid
    if row_hand_in[rowid] < 0:
        return
    grip = grips_in[particleid]
    low = lows_in[frame, particleid]
    part = parts_in[frame, particleid]
    move = (1.0 - part) * shapes_in[grip, low, 0] + part * shapes_in[grip, low + 1, 0]
    for mode in range(counts_in[grip, 0]):
        weight = positions_in[particleid, mode]
        before = weight * (1.0 - part)
        after = weight * part
        move += before * shapes_in[grip, low, 1 + mode]
        move += after * shapes_in[grip, low + 1, 1 + mode]

    place = shifts_in[particleid] + _turned(
        turns_in[particleid], wp.vec3(move[0], move[1], move[2])
    )
    quat = quat_times_exp(bases_in[particleid], wp.vec3(move[3], move[4], move[5]))
    for axis in range(3):
        pose_out[rowid, axis] = place[axis]
    for part_of_quat in range(4):
        pose_out[rowid, 3 + part_of_quat] = quat[part_of_quat]
    for angle in range(21):
        pose_out[rowid, 7 + angle] = move[6 + angle]


def decode_particles(
    counts: wp.array,
    bases: wp.array,
    times: wp.array,
    log_shares: wp.array,
    means: wp.array,
    whiteners: wp.array,
    placings: wp.array,
    positions: wp.array,
    grips: wp.array,
    *,
    warps: wp.array,
    lows: wp.array,
    parts: wp.array,
    turns: wp.array,
    shifts: wp.array,
    placed_bases: wp.array,
    densities: wp.array,
) -> None:
    """What all frames of a particle share.

    Args:
        counts: Shape modes, time modes, reference frames, components, shape (ngrip, 4).
        bases: Orientations that motions are told from, w first, shape (ngrip,) vec4.
        times: Log increments of the time warps, mean then modes, (ngrip, nref - 1, 1 + ntime).
        log_shares: Logarithm of each component's share and peak density, (ngrip, ncomponent).
        means: Their means, shape (ngrip, ncomponent, nweight).
        whiteners: Inverses of their Cholesky factors, (ngrip, ncomponent, nweight, nweight).
        placings: How they are placed, shape (1,) Placing.
        positions: Weights of shape and time, then the placement in the last six columns; a grip
            mode with fewer weights leaves those between unused; shape (nparticle, ndim).
        grips: Grip mode of each particle, shape (nparticle,).
        warps: Out: H(t; gamma) [frames], shape (nparticle, nref).
        lows: Out: reference frame at or before each wanted frame, shape (nframe, nparticle); these
            are at least two, from the last, spread evenly over the motion's duration, to the first.
        parts: Out: share of the way to the next reference frame, shape (nframe, nparticle).
        turns: Out: rotation from grasp frame to object, w first, shape (nparticle,) vec4.
        shifts: Out: place of the grasp frame's origin [m], object's frame, (nparticle,) vec3.
        placed_bases: Out: `bases` in the object's frame, w first, shape (nparticle,) vec4.
        densities: Out: ln pr of the weights, and of the placement up to a constant, (nparticle,).
    """
    wp.launch(
        _decode_particles,
        dim=positions.shape[0],
        inputs=[
            counts, bases, times, log_shares, means, whiteners, placings, positions,
            grips,
        ],
        outputs=[warps, lows, parts, turns, shifts, placed_bases, densities],
        device=positions.device,
    )  # fmt: skip


def decode_rows(
    counts: wp.array,
    shapes: wp.array,
    row_hand: wp.array,
    positions: wp.array,
    grips: wp.array,
    lows: wp.array,
    parts: wp.array,
    turns: wp.array,
    shifts: wp.array,
    placed_bases: wp.array,
    *,
    pose: wp.array,
) -> None:
    """Hand poses of some frames of all particles.

    Args:
        counts: Shape modes, time modes, reference frames, components, shape (ngrip, 4).
        shapes: Motions as increments from the base pose, mean then modes, shape
            (ngrip, nref, 1 + nshape) vec27.
        row_hand: -1 for rows to leave out, shape (nframe * nparticle,).
        positions: Coordinates of the particles, shape (nparticle, ndim).
        grips: Grip mode of each particle, shape (nparticle,).
        lows: As `decode_particles` makes it, and so all that follow, shape (nframe, nparticle).
        parts: Shape (nframe, nparticle).
        turns: Shape (nparticle,) vec4.
        shifts: Shape (nparticle,) vec3.
        placed_bases: Shape (nparticle,) vec4.
        pose: Out: hand poses, object's frame, frame by frame, shape (nframe * nparticle, 28).
    """
    wp.launch(
        _decode_rows,
        dim=lows.shape,
        inputs=[
            counts, shapes, row_hand, positions, grips, lows, parts, turns, shifts, placed_bases,
        ],
        outputs=[pose],
        device=pose.device,
    )  # fmt: skip
