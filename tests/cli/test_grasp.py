"""`handtrack grasp`: objects and meshes, what is written, bad usage."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
import trimesh

from handtrack.cli import main
from handtrack.grasp.plan import GraspPlan


def grasp(*words: object) -> int:
    return main(["grasp", *map(str, words), "--device", "cpu"])


def test_names_of_objects_and_grip_modes_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert grasp("--list") == 0
    printed = capsys.readouterr().out
    assert "apple" in printed and "ball_65" in printed and "medium_wrap" in printed


@pytest.mark.slow
def test_a_grasp_is_carried_out_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["cylinder_45_90", "--plan", tmp_path / "p.npz", "--json", tmp_path / "g.json"]
    assert grasp(*words, "--video", tmp_path / "g.mp4", "--yaw", 30, "--to", "0.2,0.1,0.1") == 0
    facts = json.loads((tmp_path / "g.json").read_text())
    assert facts["object"] == "cylinder_45_90" and facts["controller"] == "full"
    assert facts["lift_mm"] > 50.0 and facts["realtime_factor"] > 0.0
    plan = GraspPlan.load(tmp_path / "p.npz")
    assert plan.grip == facts["grip"]
    assert plan.object_poses[-1, :2] == pytest.approx([0.2, 0.1], abs=1e-6)
    video = cv2.VideoCapture(str(tmp_path / "g.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) > 60
    assert "realtime factor" in capsys.readouterr().out


@pytest.mark.slow
def test_a_mesh_file_is_planned_for_without_physics(tmp_path: Path) -> None:
    trimesh.creation.box((50, 50, 70)).export(tmp_path / "block.stl")
    words = ["--scale", 0.001, "--mass", 0.1, "--no-physics", "--grip", "tripod"]
    words += ["--json", tmp_path / "g.json", "--mjcf", tmp_path / "scene.xml"]
    assert grasp(tmp_path / "block.stl", *words) == 0
    facts = json.loads((tmp_path / "g.json").read_text())
    assert facts["mass_kg"] == 0.1 and facts["grip"] == "tripod" and "success" not in facts
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert data.body("object_0").xpos[2] == pytest.approx(0.035, abs=1e-3)
    assert data.ncon > 2  # the hand and the table touch the block


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name an object"),
        (["unicorn"], "there is no object 'unicorn'"),
        (["missing.obj"], "no mesh at"),
        (["apple", "--to", "1,2"], "expected x,y,z"),
        (["apple", "--to", "a,b,c"], "expected x,y,z"),
        (["apple", "--scale", "2"], "--scale is for mesh files"),
        (["apple", "--json", "nowhere/at/all.json"], "is no folder"),
        (["apple", "--grip", "karate"], "karate"),
    ],
)
def test_bad_usage_is_told_in_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert grasp(*words) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
