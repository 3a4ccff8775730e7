"""The examples run and reach what they claim."""

import importlib.util
from pathlib import Path

import trimesh

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(f"example_{name[:2]}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tracking_example_follows_the_sample():
    assert load("01_track_sequence").main(frames=25) < 5.0


def test_synthesis_example_follows_its_own_frames():
    assert load("02_synthesize_and_track").main(frames=20) < 6.0


def test_hand_model_example_writes_a_closed_mesh(tmp_path):
    mesh = trimesh.load(load("03_hand_model").main(tmp_path / "hand.ply"))
    assert mesh.is_watertight and mesh.volume > 1e-4


def test_every_example_is_listed_in_the_readme():
    text = (EXAMPLES / "README.md").read_text()
    assert all(path.name in text for path in EXAMPLES.glob("*.py"))
