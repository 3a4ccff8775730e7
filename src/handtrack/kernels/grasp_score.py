"""How deep hands enter an object or its table, and how good contacts are (Eq. III.6 to III.9).

Everything is in the object's frame; a row is one hand pose: one frame of one particle.
"""

from __future__ import annotations

import warp as wp

from handtrack.kernels.distance_field import DistanceGrid, grid_distance, grid_normal

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _measure_overlaps(
    # model
    group_bones_in: wp.array[int],
    group_starts_in: wp.array[int],
    group_centres_in: wp.array[wp.vec3],
    group_radii_in: wp.array[float],
    points_in: wp.array[wp.vec3],
    grid: DistanceGrid,
    table: wp.vec4,
    # in
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    # out
    depths_out: wp.array[float],
):
    """One row: the deepest skin point inside the object or below the table.

    Groups of points whose ball touches neither are passed over.
    """
    rowid = wp.tid()
    up = wp.vec3(table[0], table[1], table[2])
    deepest = float(0.0)
    for group in range(group_bones_in.shape[0]):
        bone = group_bones_in[group]
        rotation = rotations_in[rowid, bone]
        origin = origins_in[rowid, bone]
        centre = origin + rotation @ group_centres_in[group]
        # A ball matters only where it may reach deeper than what was found before it.
        reach = group_radii_in[group] - deepest
        near = grid_distance(grid, centre) < reach
        low = wp.dot(up, centre) - table[3] < reach
        if near or low:
            for k in range(group_starts_in[group], group_starts_in[group + 1]):
                point = origin + rotation @ points_in[k]
                if near:
                    deepest = wp.max(deepest, -grid_distance(grid, point))
                if low:
                    deepest = wp.max(deepest, table[3] - wp.dot(up, point))
    depths_out[rowid] = deepest


@wp.kernel
def _score_contacts(
    # model
    contact_bones_in: wp.array2d[int],
    contact_locals_in: wp.array2d[wp.vec3],
    contact_presses_in: wp.array2d[wp.vec3],
    pairs_in: wp.array3d[int],
    grid: DistanceGrid,
    # in
    grips_in: wp.array[int],
    rotations_in: wp.array2d[wp.mat33],
    origins_in: wp.array2d[wp.vec3],
    nframe: int,
    cone: float,
    # out
    points_out: wp.array2d[wp.vec3],
    normals_out: wp.array2d[wp.vec3],
    scores_out: wp.array2d[float],
):
    """One particle, in the last of its frames: Eq. III.8, both parts of III.9, and facing."""
    particleid = wp.tid()
    rowid = particleid * nframe + nframe - 1
    grip = grips_in[particleid]
    distance = float(0.0)
    facing = float(0.0)
    centroid = wp.vec3(0.0)
    count = float(0.0)
    for contact in range(contact_bones_in.shape[1]):
        bone = contact_bones_in[grip, contact]
        nearest = wp.vec3(0.0)
        normal = wp.vec3(0.0)
        if bone >= 0:
            rotation = rotations_in[rowid, bone]
            point = rotation @ contact_locals_in[grip, contact] + origins_in[rowid, bone]
            away = grid_distance(grid, point)
            normal = grid_normal(grid, point)
            nearest = point - away * normal
            press = rotation @ contact_presses_in[grip, contact]
            distance += wp.abs(away)
            facing += wp.max(0.0, 0.5 + wp.dot(press, normal))
            centroid += nearest
            count += 1.0
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
    scores_out[particleid, 1] = wp.length(centroid) / wp.max(count, 1.0)
    scores_out[particleid, 2] = angles
    scores_out[particleid, 3] = facing


def measure_overlaps(
    group_bones: wp.array,
    group_starts: wp.array,
    group_centres: wp.array,
    group_radii: wp.array,
    points: wp.array,
    grid: DistanceGrid,
    table: tuple[float, float, float, float],
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
        grid: Signed distances of the object.
        table: Unit normal of the table, up, and its height along that [m].
        rotations: R_object_bone, shape (nrow, nbone) mat33.
        origins: Bone origins [m], shape (nrow, nbone) vec3.
        depths: Out: depth of the deepest point [m], 0 where none is inside, shape (nrow,).
    """
    wp.launch(
        _measure_overlaps,
        dim=depths.shape,
        inputs=[
            group_bones, group_starts, group_centres, group_radii, points, grid, wp.vec4(*table),
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
    grid: DistanceGrid,
    grips: wp.array,
    rotations: wp.array,
    origins: wp.array,
    *,
    nframe: int,
    cone: float,
    points: wp.array,
    normals: wp.array,
    scores: wp.array,
) -> None:
    """Contacts of every particle's grasping pose, the last of its frames.

    Args:
        contact_bones: Bone of each contact of each grip mode, -1 for none, (ngrip, ncontact).
        contact_locals: Its place in the bone's frame [m], shape (ngrip, ncontact) vec3.
        contact_presses: Outward unit normal of the skin there, shape (ngrip, ncontact) vec3.
        pairs: Contacts that oppose each other, -1 for none, shape (ngrip, npair, 2).
        grid: Signed distances of the object.
        grips: Grip mode of each particle, shape (nparticle,).
        rotations: R_object_bone, shape (nparticle * nframe, nbone) mat33.
        origins: Bone origins [m], shape (nparticle * nframe, nbone) vec3.
        nframe: Rows of each particle.
        cone: Half the opening of the friction cone [rad]; angles below it cost nothing.
        points: Out: nearest points of the surface [m], shape (nparticle, ncontact) vec3.
        normals: Out: outward normals there, shape (nparticle, ncontact) vec3.
        scores: Out: sum of distances [m]; distance of the contacts' middle from the centre of mass
            [m]; sum of angles beyond the cones [rad]; by how much skin faces away from the
            surface, 0 within 60 degrees of facing it; shape (nparticle, 4).
    """
    wp.launch(
        _score_contacts,
        dim=scores.shape[0],
        inputs=[
            contact_bones, contact_locals, contact_presses, pairs, grid, grips, rotations, origins,
            nframe, cone,
        ],
        outputs=[points, normals, scores],
        device=scores.device,
    )  # fmt: skip
