"""Solids of the bones: they weigh what the skin encloses and lie on it where fingers touch."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.skeleton import BONE_PARENTS, DISTAL_BONES, NBONE
from handtrack.physics.bone_solids import FLESH_DENSITY, BoneSolid, bone_solids


def test_solids_weigh_what_the_skin_encloses(
    hand: ShapedHand, solids: tuple[BoneSolid, ...]
) -> None:
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    mesh = trimesh.Trimesh(skin(hand, pose), hand.faces, process=False)
    total = sum(solid.mass for solid in solids)
    np.testing.assert_allclose(total, FLESH_DENSITY * mesh.volume, rtol=1e-6)


def test_every_inertia_is_one_that_a_body_can_have(solids: tuple[BoneSolid, ...]) -> None:
    for solid in solids:
        small, middle, large = np.linalg.eigvalsh(solid.inertia)
        assert 0.0 < small <= middle <= large < small + middle


def test_outer_bones_are_lighter_than_inner_ones(solids: tuple[BoneSolid, ...]) -> None:
    for bone in DISTAL_BONES:
        assert solids[bone].mass < solids[BONE_PARENTS[bone]].mass


def test_pads_of_the_solids_lie_within_a_millimetre_of_the_skin(
    hand: ShapedHand, solids: tuple[BoneSolid, ...]
) -> None:
    for bone in DISTAL_BONES:
        own = (hand.weight_bones == bone) & (hand.weights > 0.9)
        points = hand.local_vertices[own]
        palmar = points[points[:, 1] > np.median(points[:, 1])]
        planes = ConvexHull(solids[bone].pieces[0]).equations
        depth = -(palmar @ planes[:, :3].T + planes[:, 3]).max(1)
        assert depth.min() > -1e-9  # the hull holds all of it
        assert np.percentile(depth, 95) < 0.001


def test_a_left_hand_has_the_mirrored_solids(solids: tuple[BoneSolid, ...]) -> None:
    left = bone_solids(HandModel.load().shaped(side="left"))
    mirror = np.diag([1.0, 1.0, -1.0])
    for bone in range(NBONE):
        np.testing.assert_allclose(left[bone].mass, solids[bone].mass, rtol=1e-12)
        np.testing.assert_allclose(left[bone].centre, mirror @ solids[bone].centre, atol=1e-12)
