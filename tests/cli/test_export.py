"""`handtrack export`: files on disk, words on the terminal, exit codes."""

from __future__ import annotations

from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.cli import main
from handtrack.cli.export import ExportOptions
from handtrack.evaluation.run_record import RunRecord
from handtrack.export.formats import FORMATS
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.tracking.result import HandResult, TrackState

CAMERA = Camera(width=32, height=24, fx=24.0, fy=24.0, cx=15.5, cy=11.5)


def save(folder: Path, states: list[TrackState]) -> Path:
    """Results of a left hand that is held still."""
    hand = HandModel.load().shaped(side="left")
    record = RunRecord(camera=CAMERA, shape=HandShape(), side="left")
    for place, state in enumerate(states):
        pose = np.zeros(28)
        pose[2], pose[3], pose[7:] = 0.5, 1.0, hand.rest_angles
        if state is TrackState.NO_HAND:
            pose[:] = np.nan
        frame = DepthFrame(
            depth=np.zeros((24, 32), np.float32), camera=CAMERA, time=place / 30, index=place
        )
        record.add(
            frame, HandResult(state=state, side="left", pose=pose, depth_error=0.0, hand=hand)
        )
    folder.mkdir(exist_ok=True)
    record.save(folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    states = [TrackState.NO_HAND, *[TrackState.TRACKING] * 3, TrackState.LOST]
    return save(tmp_path_factory.mktemp("export") / "run", states)


def test_every_format_can_be_chosen() -> None:
    assert get_args(get_type_hints(ExportOptions)["to"]) == tuple(FORMATS)


@pytest.mark.parametrize("name", FORMATS)
def test_files_are_written_and_lost_frames_told(
    folder: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / f"hand.{name}"
    source = folder if name == "bvh" else folder / "results.npz"
    assert main(["export", str(source), "--to", name, "--out", str(out)]) == 0
    assert out.stat().st_size > 100
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f"written to {out}: 5 frames of a left hand"
    expected = "the hand was followed in 3 of them; the others " + FORMATS[name].lost
    assert printed[1] == expected


@pytest.mark.parametrize("name", ["bvh", "glb"])
def test_a_hand_never_seen_has_no_motion(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = save(tmp_path / "run", [TrackState.NO_HAND] * 2)
    assert main(["export", str(folder), "--to", name, "--out", str(tmp_path / "x")]) == 2
    assert "followed in none of 2 frames" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", ["csv", "jsonl", "npz", "openxr", "trc"])
def test_a_hand_never_seen_is_told_by_formats_that_can(tmp_path: Path, name: str) -> None:
    folder = save(tmp_path / "run", [TrackState.NO_HAND] * 2)
    assert main(["export", str(folder), "--to", name, "--out", str(tmp_path / "x")]) == 0


def test_bad_input_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes((folder / "results.npz").read_bytes()[:900])
    source = str(folder / "results.npz")
    for words, message in (
        ([str(tmp_path / "no.npz"), "--to", "csv", "--out", "x"], "no such file"),
        ([str(damaged), "--to", "csv", "--out", "x"], "damaged.npz is not the results.npz"),
        ([source, "--to", "npz", "--out", source], "name another one"),
        (
            [source, "--to", "csv", "--out", str(tmp_path / "no" / "x")],
            "(No such file or directory): name a file",
        ),
    ):
        assert main(["export", *words]) == 2
        error = capsys.readouterr().err
        assert error.startswith("handtrack: error: ") and error.count("\n") == 1
        assert message in error
