"""How deep hands enter an object or its table, how good contacts are, and the costs (Eq. III.4).

Everything is in the object's frame. A row is one hand pose: one frame of one particle, frame by
frame from the last one, the grasping pose, back to the first. A search only asks which particles
are better than a bound; as costs only grow from frame to frame, most particles are given up before
their first frames are looked at.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from handtrack.kernels.distance_field import DistanceGrid, grid_distance, grid_normal

wp.set_module_options({"enable_backward": False})

ROUNDING = wp.constant(1.225)
"""Most that a distance differs from the nearest grid point's, in spacings: anywhere in a cell the
mean square of the way to its corners is at most 1.5, and no distance grows faster than the way."""

MOST_CONTACTS = 8
"""Most contacts of a grip mode."""

BALANCE_STEPS = wp.constant(16)
"""Steps of the search for the shares that balance best; each moves some from one contact to
another."""

_Shares: Any = wp.types.vector(length=MOST_CONTACTS, dtype=float)


@wp.struct
class GraspTask:
    """An object, its table, and the weights of Eq. III.4. Metres, radians."""

    grid: DistanceGrid
    table: wp.vec4
    """Unit normal of the table, up, and its height along that."""
    cone: float
    """Half the opening of the friction cone; angles below it cost nothing."""
    prior: float
    """Cost of a unit of -ln pr."""
    collision: float
    """Cost of a collision in all frames, apart from its depth."""
    depth: float
    """Cost of a metre of depth in all frames."""
    tolerance: float
    """Depth in the grasping pose that is no collision yet."""
    contact: float
    """Cost of a metre between a contact and the surface."""
    facing: float
    """Cost of a contact that presses with the wrong side."""
    centroid: float
    """Cost of a metre between the contacts' middle and the centre of mass."""
    angle: float
    """Cost of a radian beyond the friction cones."""
    balance: float
    """Cost of normal forces of which nothing cancels."""


@wp.func
def _least_distance(grid: DistanceGrid, point: wp.vec3) -> float:
    # What `grid_distance` is at least, from one number of the grid in place of eight.
    local = (point - grid.origin) / grid.spacing
    x = wp.clamp(local[0], 0.0, float(grid.values.shape[0] - 1))
    y = wp.clamp(local[1], 0.0, float(grid.values.shape[1] - 1))
    z = wp.clamp(local[2], 0.0, float(grid.values.shape[2] - 1))
    nearest = grid.values[int(x + 0.5), int(y + 0.5), int(z + 0.5)]
    aside = wp.max(wp.abs(local - wp.vec3(x, y, z)))
    return nearest + grid.spacing * (aside - ROUNDING)


@wp.func
def _may_be_inside(grid: DistanceGrid, local: wp.vec3, depth: float) -> bool:
    # Whether a place, told in spacings from the grid's first point, may be deeper than so much.
    i = int(wp.clamp(local[0], 0.0, float(grid.values.shape[0] - 1)) + 0.5)
    j = int(wp.clamp(local[1], 0.0, float(grid.values.shape[1] - 1)) + 0.5)
    k = int(wp.clamp(local[2], 0.0, float(grid.values.shape[2] - 1)) + 0.5)
    return grid.values[i, j, k] < ROUNDING * grid.spacing - depth


@wp.func
def _most_depth(task: GraspTask, total: float, bound: float, nframe: int) -> float:
    # Depth in one frame beyond which a particle that costs so much without it misses its bound.
    spare = (bound - total) * float(nframe) - task.collision
    if bound <= total:
        return -1.0
    if spare <= 0.0:
        return task.tolerance
    if task.depth * 1.0e6 < spare:
        return float(wp.inf)
    return task.tolerance + spare / task.depth


@wp.func
def _imbalance(
    points: wp.array2d[wp.vec3],
    normals: wp.array2d[wp.vec3],
    particleid: int,
    middle: wp.vec3,
    count: int,
) -> float:
    # Distance of the origin from the convex hull of the contacts' unit wrenches, torques in units
    # of the grasp's size: how far from closed the grasp would be without friction (Ferrari and
    # Canny 1992). Pairwise Frank-Wolfe steps on the contacts' shares.
    if count == 0:
        return 1.0
    size = float(0.0)
    for k in range(count):
        size += wp.length(points[particleid, k] - middle)
    scale = 1.0 / wp.max(size / float(count), 0.01)
    shares = _Shares(0.0)
    force = wp.vec3(0.0)
    torque = wp.vec3(0.0)
    for k in range(count):
        shares[k] = 1.0 / float(count)
        normal = normals[particleid, k]
        force += shares[k] * normal
        torque += shares[k] * wp.cross(scale * (points[particleid, k] - middle), normal)
    for _step in range(BALANCE_STEPS):
        least = float(1.0e30)
        most = float(-1.0e30)
        gaining = int(0)
        losing = int(0)
        for k in range(count):
            normal = normals[particleid, k]
            twist = wp.cross(scale * (points[particleid, k] - middle), normal)
            along = wp.dot(force, normal) + wp.dot(torque, twist)
            if along < least:
                least = along
                gaining = k
            if shares[k] > 0.0 and along > most:
                most = along
                losing = k
        push = normals[particleid, gaining] - normals[particleid, losing]
        twist = wp.cross(
            scale * (points[particleid, gaining] - middle), normals[particleid, gaining]
        ) - wp.cross(scale * (points[particleid, losing] - middle), normals[particleid, losing])
        square = wp.dot(push, push) + wp.dot(twist, twist)
        if most - least < 1.0e-6 or square < 1.0e-9:
            break
        moved = wp.min(shares[losing], (most - least) / square)
        shares[gaining] = shares[gaining] + moved
        shares[losing] = shares[losing] - moved
        force += moved * push
        torque += moved * twist
    return wp.sqrt(wp.dot(force, force) + wp.dot(torque, torque))


@wp.kernel
def _measure_overlaps(
    # model
    group_bones_in: wp.array[int],
    group_starts_in: wp.array[int],
    group_centres_in: wp.array[wp.vec3],
    group_radii_in: wp.array[float],
    points_in: wp.array[wp.vec3],
    # in
    tasks_in: wp.array[GraspTask],
    limits_in: wp.array[float],
    row_hand_in: wp.array[int],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    # out
    depths_out: wp.array[float],
):
    """One row: the deepest skin point inside the object or below the table.

    Groups of points whose ball touches neither are passed over.
    """
    rowid = wp.tid()
    if row_hand_in[rowid] < 0:
        return
    table = tasks_in[0].table
    grid = tasks_in[0].grid
    up = wp.vec3(table[0], table[1], table[2])
    scale = 1.0 / grid.spacing
    limit = limits_in[rowid % limits_in.shape[0]]
    deepest = float(0.0)
    for group in range(group_bones_in.shape[0]):
        if deepest > limit:
            break
        bone = group_bones_in[group]
        rotation = rotations_in[rowid, bone]
        origin = origins_in[rowid, bone]
        centre = origin + rotation @ group_centres_in[group]
        # A ball matters only where it may reach deeper than what was found before it.
        if wp.dot(up, centre) - table[3] < group_radii_in[group] - deepest:
            climb = wp.transpose(rotation) @ up
            height = wp.dot(up, origin) - table[3]
            for k in range(group_starts_in[group], group_starts_in[group + 1]):
                deepest = wp.max(deepest, -height - wp.dot(climb, points_in[k]))
        if _least_distance(grid, centre) < group_radii_in[group] - deepest:
            turn = scale * rotation
            start = scale * (origin - grid.origin)
            for k in range(group_starts_in[group], group_starts_in[group + 1]):
                if _may_be_inside(grid, start + turn @ points_in[k], deepest):
                    point = origin + rotation @ points_in[k]
                    deepest = wp.max(deepest, -grid_distance(grid, point))
    if deepest > limit:
        deepest = wp.inf
    depths_out[rowid] = deepest


@wp.kernel
def _score_contacts(
    # model
    contact_bones_in: wp.array2d[int],
    contact_locals_in: wp.array2d[wp.vec3],
    contact_presses_in: wp.array2d[wp.vec3],
    pairs_in: wp.array3d[int],
    # in
    tasks_in: wp.array[GraspTask],
    grips_in: wp.array[int],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    # out
    points_out: wp.array2d[wp.vec3],
    normals_out: wp.array2d[wp.vec3],
    scores_out: wp.array2d[float],
):
    """One particle, in its grasping pose: Eq. III.8, both parts of III.9, facing and balance."""
    particleid = wp.tid()
    grip = grips_in[particleid]
    grid = tasks_in[0].grid
    cone = tasks_in[0].cone
    distance = float(0.0)
    facing = float(0.0)
    centroid = wp.vec3(0.0)
    count = int(0)
    for contact in range(contact_bones_in.shape[1]):
        bone = contact_bones_in[grip, contact]
        nearest = wp.vec3(0.0)
        normal = wp.vec3(0.0)
        if bone >= 0:
            rotation = rotations_in[particleid, bone]
            point = rotation @ contact_locals_in[grip, contact] + origins_in[particleid, bone]
            away = grid_distance(grid, point)
            normal = grid_normal(grid, point)
            nearest = point - away * normal
            press = rotation @ contact_presses_in[grip, contact]
            distance += wp.abs(away)
            facing += wp.max(0.0, 0.5 + wp.dot(press, normal))
            centroid += nearest
            count += 1
        points_out[particleid, contact] = nearest
        normals_out[particleid, contact] = normal
    angles = float(0.0)
    for pair in range(pairs_in.shape[1]):
        a = pairs_in[grip, pair, 0]
        b = pairs_in[grip, pair, 1]
        if a >= 0:
            line = wp.normalize(points_out[particleid, b] - points_out[particleid, a])
            into_a = wp.acos(wp.clamp(-wp.dot(line, normals_out[particleid, a]), -1.0, 1.0))
            into_b = wp.acos(wp.clamp(wp.dot(line, normals_out[particleid, b]), -1.0, 1.0))
            angles += wp.max(0.0, into_a - cone) + wp.max(0.0, into_b - cone)
    scores_out[particleid, 0] = distance
    middle = centroid / float(wp.max(count, 1))
    scores_out[particleid, 1] = wp.length(middle)
    scores_out[particleid, 2] = angles
    scores_out[particleid, 3] = facing
    scores_out[particleid, 4] = _imbalance(points_out, normals_out, particleid, middle, count)


@wp.kernel
def _weigh_contacts(
    # in
    tasks_in: wp.array[GraspTask],
    densities_in: wp.array[float],
    scores_in: wp.array2d[float],
    bounds_in: wp.array[float],
    nframe: int,
    # out
    terms_out: wp.array2d[float],
    limits_out: wp.array[float],
):
    """One particle: all terms that do not depend on overlaps; no collision yet."""
    particleid = wp.tid()
    task = tasks_in[0]
    prior = -task.prior * densities_in[particleid]
    contact = task.contact * scores_in[particleid, 0] + task.facing * scores_in[particleid, 3]
    quality = task.centroid * scores_in[particleid, 1] + task.angle * scores_in[particleid, 2]
    quality += task.balance * scores_in[particleid, 4]
    terms_out[particleid, 0] = prior
    terms_out[particleid, 1] = 0.0
    terms_out[particleid, 2] = contact
    terms_out[particleid, 3] = quality
    limits_out[particleid] = _most_depth(
        task, prior + contact + quality, bounds_in[particleid], nframe
    )


@wp.kernel
def _weigh_overlaps(
    # in
    tasks_in: wp.array[GraspTask],
    bounds_in: wp.array[float],
    depths_in: wp.array[float],
    begin: int,
    end: int,
    nframe: int,
    # out
    terms_io: wp.array2d[float],
    totals_io: wp.array[float],
    limits_io: wp.array[float],
    row_hand_io: wp.array[int],
):
    """One particle: the cost of its overlaps in some frames, and whether the others matter."""
    particleid = wp.tid()
    count = totals_io.shape[0]
    if row_hand_io[begin * count + particleid] < 0:
        return
    task = tasks_in[0]
    cost = float(0.0)
    for frame in range(begin, end):
        over = depths_in[frame * count + particleid]
        if frame == 0:
            over -= task.tolerance  # no finger touches before the grasp
        if over > 0.0:
            cost += task.collision + task.depth * over
    terms_io[particleid, 1] += cost / float(nframe)
    total = (
        terms_io[particleid, 0]
        + terms_io[particleid, 1]
        + terms_io[particleid, 2]
        + terms_io[particleid, 3]
    )
    hand = int(0)
    if total >= bounds_in[particleid]:
        total = wp.inf
        hand = -1
    totals_io[particleid] = total
    limits_io[particleid] = _most_depth(task, total, bounds_in[particleid], nframe)
    for frame in range(end, nframe):
        row_hand_io[frame * count + particleid] = hand


def measure_overlaps(
    group_bones: wp.array,
    group_starts: wp.array,
    group_centres: wp.array,
    group_radii: wp.array,
    points: wp.array,
    tasks: wp.array,
    limits: wp.array,
    row_hand: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    depths: wp.array,
) -> None:
    """How deep every row's hand enters the object or its table.

    Args:
        group_bones: Bone of each group of skin points, shape (ngroup,).
        group_starts: First point of each group and the end of the last, shape (ngroup + 1,).
        group_centres: Centre of a ball around each group [m], bone frame, shape (ngroup,) vec3.
        group_radii: Radii of the balls [m], shape (ngroup,).
        points: Points of the skin [m], bone frames, group by group, shape (npoint,) vec3.
        tasks: The object, shape (1,) GraspTask.
        limits: Depth beyond which it does not matter how deep [m], shape (nparticle,); rows are
            those of all particles once or several times.
        row_hand: -1 for rows to leave out, shape (nrow,).
        rotations: R_object_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        depths: Out: depth of the deepest point [m], 0 where none is inside and inf where it is
            beyond the limit, shape (nrow,).
    """
    wp.launch(
        _measure_overlaps,
        dim=depths.shape,
        inputs=[
            group_bones, group_starts, group_centres, group_radii, points, tasks, limits, row_hand,
            rotations, origins,
        ],
        outputs=[depths],
        device=depths.device,
    )  # fmt: skip


def score_contacts(
    contact_bones: wp.array,
    contact_locals: wp.array,
    contact_presses: wp.array,
    pairs: wp.array,
    tasks: wp.array,
    grips: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    points: wp.array,
    normals: wp.array,
    scores: wp.array,
) -> None:
    """Contacts of every particle's grasping pose.

    Args:
        contact_bones: Bone of each contact of each grip mode, then -1 for none, shape (ngrip,
            ncontact) of `MOST_CONTACTS` at most.
        contact_locals: Its place in the bone's frame [m], shape (ngrip, ncontact) vec3.
        contact_presses: Outward unit normal of the skin there, shape (ngrip, ncontact) vec3.
        pairs: Contacts that oppose each other, -1 for none, shape (ngrip, npair, 2).
        tasks: The object, shape (1,) GraspTask.
        grips: Grip mode of each particle, shape (nparticle,).
        rotations: R_object_bone, the first rows, shape (nparticle or more, nbone) mat33.
        origins: Bone origins [m], shape (nparticle or more, nbone) vec3.
        points: Out: nearest points of the surface [m], shape (nparticle, ncontact) vec3.
        normals: Out: outward normals there, shape (nparticle, ncontact) vec3.
        scores: Out: sum of distances [m]; distance of the contacts' middle from the centre of mass
            [m]; sum of angles beyond the cones [rad]; by how much skin faces away from the
            surface, 0 within 60 degrees of facing it; what remains of the best balanced normal
            forces of sum one, 0 to 1; shape (nparticle, 5).
    """
    wp.launch(
        _score_contacts,
        dim=scores.shape[0],
        inputs=[
            contact_bones, contact_locals, contact_presses, pairs, tasks, grips, rotations, origins,
        ],
        outputs=[points, normals, scores],
        device=scores.device,
    )  # fmt: skip


def weigh_contacts(
    tasks: wp.array,
    densities: wp.array,
    scores: wp.array,
    bounds: wp.array,
    nframe: int,
    *,
    terms: wp.array,
    limits: wp.array,
) -> None:
    """Terms of the objective before overlaps are looked at.

    Args:
        tasks: Weights, shape (1,) GraspTask.
        densities: ln pr of each particle's coordinates, shape (nparticle,).
        scores: What `score_contacts` measured, shape (nparticle, 5).
        bounds: Cost that each particle must be below, shape (nparticle,).
        nframe: Number of frames.
        terms: Out: prior, collision (0), contact and quality, shape (nparticle, 4).
        limits: Out: depth in one frame that is too deep [m], shape (nparticle,).
    """
    wp.launch(
        _weigh_contacts,
        dim=terms.shape[0],
        inputs=[tasks, densities, scores, bounds, nframe],
        outputs=[terms, limits],
        device=terms.device,
    )


def weigh_overlaps(
    tasks: wp.array,
    bounds: wp.array,
    depths: wp.array,
    frames: tuple[int, int],
    nframe: int,
    *,
    terms: wp.array,
    totals: wp.array,
    limits: wp.array,
    row_hand: wp.array,
) -> None:
    """Add the cost of overlaps in some frames, and give up particles that are no better.

    Args:
        tasks: Weights, shape (1,) GraspTask.
        bounds: Cost that each particle must be below, shape (nparticle,).
        depths: Depths [m], frame by frame from the grasping pose back, (nframe * nparticle,).
        frames: First of the frames, and the one after the last.
        nframe: Number of frames.
        terms: In and out: prior, collision, contact and quality, shape (nparticle, 4).
        totals: In and out: their sum so far; inf when given up, shape (nparticle,).
        limits: In and out: depth in one frame that is too deep [m], shape (nparticle,).
        row_hand: In and out: 0, or -1 in the frames after these of particles that were given up,
            shape (nframe * nparticle,).
    """
    begin, end = frames
    wp.launch(
        _weigh_overlaps,
        dim=totals.shape[0],
        inputs=[tasks, bounds, depths, begin, end, nframe],
        outputs=[terms, totals, limits, row_hand],
        device=totals.device,
    )
