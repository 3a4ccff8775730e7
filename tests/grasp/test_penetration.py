"""How deep the skin enters: against a sphere, whose distances are known."""

from __future__ import annotations

import numpy as np

from handtrack.grasp.penetration import skin_depths
from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel
from handtrack.objects.distance_field import DistanceField
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import sphere


def test_depth_of_the_skin_in_a_ball_is_that_of_its_deepest_vertex(
    rng: np.random.Generator,
) -> None:
    hand = HandModel.load().shaped()
    field = DistanceField.of(
        RigidObject.of_shape(sphere(0.06), name="ball", mass=0.1), device="cpu"
    )
    poses = np.zeros((70, 28))
    poses[:, 3], poses[:, 7:] = 1.0, hand.rest_angles
    things = np.zeros((70, 7))
    things[:, :3] = rng.uniform([0.0, 0.0, -0.05], [0.2, 0.06, 0.05], (70, 3))
    for row in things:
        row[3:] = rng.normal(size=4)
        row[3:] /= np.linalg.norm(row[3:])
    depths = skin_depths(hand, poses, field, things)
    away = np.linalg.norm(skin(hand, poses) - things[:, None, :3], axis=-1).min(1)
    # The grid of 2 mm rounds the tip that the distances have in the ball's middle.
    np.testing.assert_allclose(depths, np.maximum(0.03 - away, 0.0), atol=6e-4)
    assert (depths == 0.0).any() and depths.max() > 0.005
