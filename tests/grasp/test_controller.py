"""The controller: what the servo holds, and what each variant asks of the fingers."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from handtrack.errors import InputError
from handtrack.grasp.controller import GraspController, Target
from handtrack.grasp.gains import Gains
from handtrack.grasp.reference import Stage
from handtrack.hand.model import HandModel
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box
from handtrack.physics.hand_body import LAYOUTS, Layout
from handtrack.physics.layout import HandLayout
from handtrack.physics.scene import Scene

BLOCK = RigidObject.of_shape(box(0.05, 0.05, 0.05), name="block", mass=0.1)
HAND = HandModel.load().shaped()


def world(layout: Layout = "tracking") -> tuple[Scene, np.ndarray]:
    scene = Scene(HAND, [BLOCK], layout=layout)
    pose = np.zeros(28)
    pose[2], pose[3], pose[7:] = 0.3, 1.0, HAND.rest_angles
    scene.set_object(0, (0.5, 0.0, BLOCK.rest_height, 1, 0, 0, 0))
    scene.set_hand(pose)
    return scene, pose


def controller(scene: Scene, **options) -> GraspController:
    none = np.zeros(0, np.int64)
    return GraspController(scene, none, np.zeros((0, 3)), np.zeros((0, 3)), **options)


def target(scene: Scene, pose: np.ndarray, stage: Stage = Stage.REACHING) -> Target:
    return Target(
        hand=scene.layout.qpos(pose), hand_velocity=np.zeros(scene.layout.nv),
        thing=scene.object_pose(0), thing_velocity=np.zeros(6), stage=stage,
    )  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_servo_reaches_a_pose_and_does_not_sag(layout: Layout) -> None:
    scene, pose = world(layout)
    pose[:3] += (0.02, -0.01, 0.03)
    pose[[12, 14, 15, 16, 18, 19]] += 0.3
    control, goal = controller(scene), target(scene, pose)
    for _ in range(1500):
        scene.apply(control.torques(goal))
        scene.step()
    np.testing.assert_allclose(scene.hand_pose(), pose, atol=2e-3)


def test_servo_stays_calm_with_the_tables_damping() -> None:
    scene, pose = world()
    control, goal = controller(scene), target(scene, pose)
    kick = np.zeros(27)
    kick[6:] = 5.0
    scene.set_hand(pose, kick)
    for _ in range(400):
        scene.apply(control.torques(goal))
        scene.step()
        assert np.abs(scene.hand_velocity()).max() < 10.0
    assert np.abs(scene.hand_velocity()).max() < 0.5


def test_only_the_full_variant_pushes_planned_contacts_on() -> None:
    torques = {}
    for variant in ("full", "pd", "pollard-zordan"):
        scene, pose = world()
        scene.set_object(0, (0.15, 0.15, 0.3, 1, 0, 0, 0))
        control = GraspController(
            scene, np.array([6]), np.array([[0.0, -0.025, 0.0]]), np.array([[0.0, -1.0, 0.0]]),
            variant=variant,
        )  # fmt: skip
        goal = target(scene, pose, Stage.TAKING)
        for _ in range(2):
            torques[variant] = control.torques(goal)
    np.testing.assert_allclose(torques["pd"], torques["pollard-zordan"])
    push = torques["full"] - torques["pd"]
    # The push goes along +y of the world, which bends the index finger of this hand.
    assert push[11] > 1e-3 and push[1] > 0.3


def test_table_of_gains_is_that_of_the_thesis() -> None:
    gains = Gains()
    stiffness, damping = gains.of_hand(HandLayout(HAND, "ball").bone_dofs())
    assert stiffness[:6].tolist() == [400.0] * 3 + [600.0] * 3
    assert stiffness[6:13].tolist() == [10.0] * 3 + [8.0] * 3 + [4.0]
    assert damping[13:18].tolist() == [0.2] * 3 + [0.1] * 2


def test_bad_settings_are_refused() -> None:
    scene, _ = world()
    with pytest.raises(InputError, match="full, pd, pollard-zordan"):
        controller(scene, variant="lqr")
    with pytest.raises(InputError, match="five fingers"):
        Gains(finger_stiffness=((1.0, 1.0, 1.0),))
    with pytest.raises(InputError, match="at least 0"):
        Gains(root_translation=(-1.0, 0.0))
