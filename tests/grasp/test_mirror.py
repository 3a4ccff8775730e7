"""Mirroring a grasp: everything together is its mirror image."""

from __future__ import annotations

import numpy as np

from handtrack.grasp.mirror import (
    FLIP,
    mirrored_field,
    mirrored_object,
    mirrored_object_poses,
    mirrored_plan,
    mirrored_wish,
)
from handtrack.grasp.objective import Wish
from handtrack.grasp.plan import GraspPlan
from handtrack.grasp.taxonomy import grip_pads
from handtrack.hand.inverse_kinematics import BonePoints
from handtrack.hand.model import HandModel
from handtrack.hand.side import mirror_pose
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.library import load_object
from handtrack.transforms import quat_to_matrix


def a_pose(rng: np.random.Generator, size: int) -> np.ndarray:
    pose = rng.normal(0.0, 0.2, size)
    pose[3:7] = rng.standard_normal(4)
    pose[3:7] /= np.linalg.norm(pose[3:7])
    return pose


def test_a_mirrored_object_is_the_mirror_image_in_the_world(rng: np.random.Generator) -> None:
    body = load_object("banana")
    image, pose = mirrored_object(body), a_pose(rng, 7)
    seen = (body.vertices @ quat_to_matrix(pose[3:]).T + pose[:3]) * FLIP
    other = mirrored_object_poses(pose)
    there = image.vertices @ quat_to_matrix(other[3:]).T + other[:3]
    np.testing.assert_allclose(there, seen, atol=1e-12)
    corners = image.vertices[image.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.einsum("fi,fi->", corners[:, 0], normals) > 0  # still outward
    assert np.linalg.eigvalsh(image.inertia).min() > 0


def test_a_mirrored_field_measures_the_mirror_image(rng: np.random.Generator) -> None:
    field = DistanceField.of(load_object("banana"), device="cpu", spacing=0.004)
    points = rng.normal(0.0, 0.05, (200, 3))
    np.testing.assert_allclose(
        mirrored_field(field).distance(points * FLIP), field.distance(points), atol=1e-9
    )


def test_contacts_of_a_mirrored_plan_are_mirrored_points(rng: np.random.Generator) -> None:
    right, left = (HandModel.load().shaped(side=side) for side in ("right", "left"))
    pads = grip_pads(right, "tripod")
    poses = np.array([a_pose(rng, 28), a_pose(rng, 28)])
    plan = GraspPlan(
        grip="tripod", times=np.array([0.0, 1.0]), hand_poses=poses,
        object_poses=np.array([a_pose(rng, 7), a_pose(rng, 7)]),
        phases=np.array(["closing", "closing"]), contact_bones=pads.bones,
        contact_local=pads.points, contact_points=rng.normal(size=(3, 3)),
        contact_normals=rng.normal(size=(3, 3)), feasible=True,
    )  # fmt: skip
    image = mirrored_plan(plan)
    before = BonePoints(bones=pads.bones, offsets=pads.points).place(right, poses)
    after = BonePoints(bones=image.contact_bones, offsets=image.contact_local).place(
        left, image.hand_poses
    )
    np.testing.assert_allclose(after, before * FLIP, atol=1e-12)
    again = mirrored_plan(image)
    np.testing.assert_allclose(again.contact_points, plan.contact_points)
    np.testing.assert_allclose(again.object_poses, plan.object_poses)


def test_a_wish_is_mirrored_as_far_as_it_goes(rng: np.random.Generator) -> None:
    pose = a_pose(rng, 28)
    wish = mirrored_wish(Wish(contact_points=np.array([[1.0, 2.0, 3.0]]), hand_pose=pose))
    np.testing.assert_array_equal(wish.contact_points, [[-1.0, 2.0, 3.0]])
    np.testing.assert_allclose(wish.hand_pose, mirror_pose(pose))
    assert mirrored_wish(Wish()).hand_pose is None
