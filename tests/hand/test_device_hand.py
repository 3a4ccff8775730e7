"""The hand's arrays on a device, and the spheres inside its fingers."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from handtrack.fitting.spheres import CollisionSpheres
from handtrack.hand.device_hand import DeviceHand
from handtrack.hand.kinematics import bone_frames, skin
from handtrack.hand.side import MIRROR
from handtrack.hand.skeleton import ANGLE_BONES, DISTAL_BONES, finger_of_bone
from oracles.device_arrays import download
from oracles.energy import Spheres
from oracles.scenes import seen_poses, shaped_hand


def test_vertices_depend_on_their_own_finger_only(device: str) -> None:
    hand = shaped_hand("right", 1)
    chains = download(DeviceHand.upload([hand], wp.get_device(device)).vertex_chains)
    assert set(chains) == {-1, 0, 1, 2, 3, 4}
    for bones, weights, chain in zip(hand.weight_bones, hand.weights, chains, strict=True):
        fingers = {finger_of_bone(int(b)) for b, w in zip(bones, weights, strict=True) if w > 0}
        assert fingers <= {-1, chain}
        assert chain == -1 or chain in fingers


def test_angles_of_a_bone_are_listed_outermost_first(device: str) -> None:
    uploaded = DeviceHand.upload([shaped_hand()], wp.get_device(device))
    bone_angles = download(uploaded.bone_angles)
    for bone, angles in enumerate(bone_angles):
        expected = [angle for angle, moved in enumerate(ANGLE_BONES) if moved == bone]
        assert [a for a in angles if a >= 0] == expected
    np.testing.assert_array_equal(download(uploaded.angle_bones), ANGLE_BONES)


def test_the_forearm_stub_is_behind_the_wrist(device: str) -> None:
    hand = shaped_hand("right", 1)
    is_hand = download(DeviceHand.upload([hand], wp.get_device(device)).vertex_is_hand) > 0
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    vertices = skin(hand, pose)
    assert is_hand.any() and not is_hand.all()
    assert (vertices[~is_hand, 0] <= 1e-6).all()
    # A vertex that a finger moves is never the forearm's.
    moved = ((hand.weight_bones > 0) & (hand.weights > 0)).any(1)
    assert is_hand[moved & (vertices[:, 0] > 0)].all()


def test_several_hands_keep_their_own_shapes(device: str) -> None:
    hands = [shaped_hand("left", person) for person in (1, 2, 3)]
    uploaded = DeviceHand.upload(hands, wp.get_device(device))
    for index, hand in enumerate(hands):
        for name in ("local_vertices", "local_normals", "bone_origins", "angle_axes"):
            found = download(getattr(uploaded, name))[index]
            np.testing.assert_allclose(found, getattr(hand, name), atol=1e-7)


@pytest.mark.parametrize("side", ["right", "left"])
def test_spheres_lie_inside_the_flesh(device: str, side: str) -> None:
    hand = shaped_hand(side, 2)
    spheres = CollisionSpheres.build([hand], wp.get_device(device))
    bones, radii = download(spheres.bones), download(spheres.radii)[0]
    assert spheres.count == len(bones) == 3 * 15
    assert (radii > 0.003).all() and (radii < 0.03).all()
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, hand.rest_angles
    rotations, origins = bone_frames(hand, pose)
    local = download(spheres.centres)[0]
    centres = (rotations[bones] @ local[..., None])[..., 0] + origins[bones]
    vertices = skin(hand, pose)
    fingers = np.array([finger_of_bone(int(b)) for b in bones])
    for centre, radius, bone in zip(centres, radii, bones, strict=True):
        if bone in (1, *DISTAL_BONES) or finger_of_bone(int(bone)) < 0:
            continue
        # No skin deep inside a sphere, and none far from it.
        nearest = np.linalg.norm(vertices - centre, axis=1).min()
        assert 0.5 * radius < nearest < 1.3 * radius
    assert set(fingers) == set(range(5))


def test_spheres_of_the_left_hand_are_mirrored(device: str) -> None:
    right, left = (
        CollisionSpheres.build([shaped_hand(side, 2)], wp.get_device(device))
        for side in ("right", "left")
    )
    np.testing.assert_allclose(download(left.centres), download(right.centres) * MIRROR, atol=1e-7)
    np.testing.assert_allclose(download(left.radii), download(right.radii), atol=1e-7)
    np.testing.assert_array_equal(download(left.pairs), download(right.pairs))


def test_pairs_are_of_different_fingers_and_a_flat_hand_does_not_collide(device: str, rng) -> None:
    hand = shaped_hand("right", 2)
    built = CollisionSpheres.build([hand], wp.get_device(device))
    bones, pairs = download(built.bones), download(built.pairs)
    fingers = np.array([finger_of_bone(int(b)) for b in bones])
    assert (fingers[pairs[:, 0]] != fingers[pairs[:, 1]]).all()
    assert len({tuple(sorted(pair)) for pair in pairs.tolist()}) == len(pairs)
    spheres = Spheres(hand, bones, download(built.centres)[0], download(built.radii)[0], pairs)
    rest = seen_poses(hand, rng, 1, bend=0.0)[0]
    # Relaxed fingers touch at most; crossed ones overlap.
    assert spheres.overlaps(rest).max() < 0.002
    crossed = rest.copy()
    # The index away from the thumb, the middle finger towards it.
    crossed[7 + 6], crossed[7 + 10] = -0.3, 0.3
    assert spheres.overlaps(crossed).max() > 0.003
