"""The simulated world: kinematics and forces agree with the hand model and with the textbook."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.model import ShapedHand
from handtrack.objects.rigid_object import RigidObject
from handtrack.objects.shapes import box, sphere
from handtrack.physics.bone_solids import BoneSolid
from handtrack.physics.hand_body import LAYOUTS, Layout
from handtrack.physics.scene import Scene, SceneConfig
from handtrack.transforms import matrix_to_rotvec

BLOCK = RigidObject.of_shape(box(0.05, 0.05, 0.05), name="block", mass=0.1)


@pytest.fixture(params=LAYOUTS)
def layout(request: pytest.FixtureRequest) -> Layout:
    return request.param


def lifted(hand: ShapedHand, height: float = 0.3) -> np.ndarray:
    pose = np.zeros(28)
    pose[2], pose[3], pose[7:] = height, 1.0, hand.rest_angles
    return pose


@pytest.fixture
def scene(hand: ShapedHand, solids: tuple[BoneSolid, ...], layout: Layout) -> Scene:
    scene = Scene(hand, [BLOCK], layout=layout, solids=solids)
    scene.set_object(0, (0.4, 0.0, BLOCK.rest_height, 1, 0, 0, 0))
    return scene


def test_bones_stand_where_the_hand_model_has_them(
    scene: Scene, hand: ShapedHand, rng: np.random.Generator
) -> None:
    pose = lifted(hand)
    pose[3:7] = rng.normal(size=4)
    pose[3:7] /= np.linalg.norm(pose[3:7])
    pose[7:] = rng.uniform(*hand.limits.T)
    scene.set_hand(pose)
    rotations, origins = bone_frames(hand, pose)
    for bone in range(16):
        rotation, origin = scene.bone_frame(bone)
        np.testing.assert_allclose(rotation, rotations[bone], atol=1e-9)
        np.testing.assert_allclose(origin, origins[bone], atol=1e-9)


def test_an_undriven_hand_falls_freely(scene: Scene, hand: ShapedHand) -> None:
    scene.set_hand(lifted(hand))
    for _ in range(100):
        scene.step()
    # The centre of mass falls g t^2 / 2; symplectic steps add g t dt / 2.
    masses = scene.model.body_mass[1:17]
    centre = (masses @ scene.data.xipos[1:17]) / masses.sum()
    fresh = Scene(hand, [BLOCK], layout=scene.layout.layout)
    fresh.set_hand(lifted(hand))
    start = (masses @ fresh.data.xipos[1:17]) / masses.sum()
    np.testing.assert_allclose(start - centre, [0, 0, 0.5 * 9.81 * (0.01 + 0.0001)], atol=2e-4)


def test_gravity_compensation_keeps_the_hand_where_it_is(scene: Scene, hand: ShapedHand) -> None:
    pose = lifted(hand)
    scene.set_hand(pose)
    for _ in range(200):
        scene.apply(scene.hand_bias())
        scene.step()
    np.testing.assert_allclose(scene.hand_pose(), pose, atol=1e-5)


def test_joint_limits_hold(scene: Scene, hand: ShapedHand) -> None:
    scene.set_hand(lifted(hand))
    push = np.zeros(scene.layout.nv)
    push[6:] = 0.005
    for _ in range(300):
        scene.apply(scene.hand_bias() + push)
        scene.step()
    angles = scene.hand_pose()[7:]
    if scene.layout.layout == "tracking":
        assert (angles < hand.limits[:, 1] + np.deg2rad(8.0)).all()
    dip = [8, 12, 16, 20]
    assert (angles[dip] < hand.limits[dip, 1] + np.deg2rad(8.0)).all()


def test_joint_torques_of_a_force_are_its_work_by_central_differences(
    scene: Scene, hand: ShapedHand
) -> None:
    pose = lifted(hand)
    scene.set_hand(pose)
    bone, local = 6, np.array([0.01, 0.005, 0.0])
    rotation, origin = scene.bone_frame(bone)
    force, point = np.array([0.3, -0.5, 0.8]), origin + rotation @ local
    torque = scene.hand_torque([(bone, point, np.array([*force, 0.0, 0.0, 0.0]))])
    moment = np.array([0.1, 0.4, -0.2])
    turning = scene.hand_torque([(bone, point, np.array([0.0, 0.0, 0.0, *moment]))])
    both = scene.hand_torque(
        [(bone, point, np.zeros(6)), (bone, point, np.array([*force, *moment]))]
    )
    np.testing.assert_allclose(both, torque + turning, atol=1e-12)
    start = scene.data.qpos.copy()
    for dof in range(scene.layout.nv):
        places, turns = [], []
        for sign in (1.0, -1.0):
            way = np.zeros(scene.model.nv)
            way[dof] = sign
            scene.data.qpos[:] = start
            mujoco.mj_integratePos(scene.model, scene.data.qpos, way, 1e-6)
            mujoco.mj_kinematics(scene.model, scene.data)
            rotation, origin = scene.bone_frame(bone)
            places.append(origin + rotation @ local)
            turns.append(rotation)
        work = force @ (places[0] - places[1]) / 2e-6
        np.testing.assert_allclose(torque[dof], work, atol=1e-7)
        spin = matrix_to_rotvec(turns[0] @ turns[1].T) / 2e-6
        np.testing.assert_allclose(turning[dof], moment @ spin, atol=1e-6)


def test_a_block_at_rest_stays_and_does_not_sink(scene: Scene) -> None:
    for _ in range(300):
        scene.step()
    pose = scene.object_pose(0)
    np.testing.assert_allclose(pose, [0.4, 0, BLOCK.rest_height, 1, 0, 0, 0], atol=2e-4)
    assert scene.supported(0) and not len(scene.contacts(0))


def test_a_block_on_the_back_of_the_hand_is_carried_by_contact_forces(
    hand: ShapedHand, solids: tuple[BoneSolid, ...]
) -> None:
    scene = Scene(hand, [BLOCK], solids=solids, table=False)
    pose = lifted(hand)
    pose[3:7] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]  # palm up: y of the palm is up
    scene.set_hand(pose)
    place = np.array([0.06, 0.0, 0.38, 1, 0, 0, 0])
    scene.set_object(0, place)
    from handtrack.grasp.controller import GraspController, Target
    from handtrack.grasp.reference import Stage

    none = np.zeros(0, np.int64)
    control = GraspController(scene, none, np.zeros((0, 3)), np.zeros((0, 3)), variant="pd")
    goal = Target(
        hand=pose, hand_velocity=np.zeros(27), thing=place, thing_velocity=np.zeros(6),
        stage=Stage.REACHING,
    )  # fmt: skip
    total = np.zeros(3)
    for k in range(1500):
        scene.apply(control.torques(goal))
        scene.step()
        if k >= 1300:
            contacts = scene.contacts(0)
            total += contacts.forces.sum(0) / 200
    assert len(scene.contacts(0)) and not scene.supported(0)
    np.testing.assert_allclose(total, [0, 0, 0.1 * 9.81], atol=0.03)
    patches = contacts.patches()
    np.testing.assert_allclose(patches.forces.sum(0), contacts.forces.sum(0), atol=1e-12)
    assert len(set(patches.bones.tolist())) == len(patches)


def test_nothing_but_the_hand_is_driven(scene: Scene) -> None:
    scene.apply(np.ones(scene.layout.nv))
    assert not scene.objects_driven() and scene.model.neq == 0
    scene.data.qfrc_applied[-1] = 0.1
    assert scene.objects_driven()


def test_two_runs_are_the_same(hand: ShapedHand, solids: tuple[BoneSolid, ...]) -> None:
    ends = []
    for _ in range(2):
        scene = Scene(hand, [BLOCK], solids=solids)
        scene.set_hand(lifted(hand, 0.12))
        for _ in range(200):
            scene.step()
        ends.append(scene.data.qpos.copy())
    np.testing.assert_array_equal(*ends)


def test_saved_model_opens_in_mujoco(scene: Scene, tmp_path: Path) -> None:
    scene.save(tmp_path / "scene.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    assert (model.nq, model.nv, model.ngeom) == (
        scene.model.nq, scene.model.nv, scene.model.ngeom,
    )  # fmt: skip
    np.testing.assert_allclose(model.key("now").qpos, scene.data.qpos, atol=1e-5)
    np.testing.assert_allclose(model.jnt_range, scene.model.jnt_range, atol=1e-5)
    np.testing.assert_allclose(model.body_mass, scene.model.body_mass, rtol=1e-4)


def test_friction_of_the_object_decides_not_that_of_the_skin(
    hand: ShapedHand, solids: tuple[BoneSolid, ...]
) -> None:
    slippery = replace(RigidObject.of_shape(sphere(0.05), name="ball", mass=0.1), friction=0.2)
    scene = Scene(hand, [slippery], solids=solids)
    geom = scene.model.geom("object_0")
    assert geom.friction[0] == pytest.approx(0.2) and geom.priority[0] == 1


def test_an_unstable_simulation_says_so_and_leaves_no_file(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert not scene.burst
    scene.apply(np.full(scene.layout.nv, 1e15))
    for _ in range(5):
        scene.step()
    assert scene.burst
    assert "unstable" in caplog.text and not list(tmp_path.iterdir())


@pytest.mark.parametrize("force", [np.nan, np.inf, 1e25])
def test_what_is_not_finite_never_leaves_the_simulator(scene: Scene, force: float) -> None:
    scene.apply(np.full(scene.layout.nv, force))
    for _ in range(5):
        scene.step()
        seen = (
            scene.hand_pose(), scene.hand_velocity(), scene.hand_bias(), scene.hand_inertia(),
            scene.hand_constraint(), scene.object_pose(0), scene.object_velocity(0),
            scene.contacts(0).forces, scene.contacts(0).patches().forces,
        )  # fmt: skip
        assert all(np.isfinite(values).all() for values in seen)
    assert scene.burst


def test_bad_input_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match="28"):
        scene.set_hand(np.zeros(27))
    with pytest.raises(InputError, match="no object 1"):
        scene.object_pose(1)
    with pytest.raises(InputError, match="two time steps"):
        SceneConfig(timestep=0.004)
    with pytest.raises(InputError, match="3, 4 or 6"):
        SceneConfig(contact_dims=5)
