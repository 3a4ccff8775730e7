"""`handtrack bench`: tables, the benchmark file, pictures, recorded sequences, bad usage."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cli.short_runs import synthesise
from handtrack.cli import main
from handtrack.evaluation.suites.suite import SUITES


def bench(*words: object) -> int:
    return main(["bench", *map(str, words), "--device", "cpu"])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with what a quick selftest of two trackers writes."""
    folder = tmp_path_factory.mktemp("bench")
    words = ["--tracker", "model_based", "--tracker", "thesis", "--curves", folder / "curves"]
    assert bench("selftest", "--quick", *words, "--json", folder / "s.json") == 0
    return folder


@pytest.fixture(scope="module")
def document(written: Path) -> dict[str, Any]:
    return json.loads((written / "s.json").read_text())


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few synthesised frames of a subject, with truth."""
    return synthesise(tmp_path_factory.mktemp("recording") / "hand.npz", 8, "--subject", "3")


def test_the_file_holds_suite_device_versions_and_cases(document: dict[str, Any]) -> None:
    assert document["suite"] == "selftest" and document["device"].startswith("cpu")
    assert {"handtrack", "python", "warp", "cpu"} <= set(document["versions"])
    assert document["quick"] is True
    assert document["command"] == (
        "handtrack bench selftest --tracker model_based --tracker thesis --quick --device cpu"
    )
    assert [case["tracker"] for case in document["cases"]] == ["model_based", "thesis"]
    for case in document["cases"]:
        assert case["case"] == "selftest"
        assert {"mean", "median", "max_frame"} <= set(case["phalanx_error_mm"])
        assert case["frames_per_second"] > 0 and case["stage_ms"]
        assert 0 <= case["lost_rate"] <= 1 and {"20", "30"} <= set(case["success_rate"])


def test_targets_are_written_with_what_was_reached(document: dict[str, Any]) -> None:
    for target in document["targets"]:
        key = target["value"].split(".")[1]
        reached = document["cases"][0]["phalanx_error_mm"][key]
        assert target["tracker"] == "model_based" and target["reached"] == reached
        assert target["passed"] == (reached <= target["at_most"])


def test_curves_are_drawn(written: Path) -> None:
    pictures = sorted(path.name for path in (written / "curves").iterdir())
    assert pictures == ["selftest-error-0.png", "selftest-error-1.png", "selftest-success.png"]
    for name in pictures:
        image = cv2.imread(str(written / "curves" / name))
        assert image is not None and len(np.unique(image.reshape(-1, 3), axis=0)) > 5


def test_a_recorded_sequence_is_compared_over_trackers(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--tracker", "model_based", "--tracker", "thesis", "--pictures", tmp_path / "p"]
    assert bench("--sequence", recording, *words, "--json", tmp_path / "b.json") == 0
    printed = capsys.readouterr().out
    # Accuracy first, speed last.
    head = next(line for line in printed.splitlines() if "mean mm" in line)
    assert head.index("mean mm") < head.index("lost") < head.index("frames/s")
    assert "shape: from the sequence" in printed and "labels of frame 0" in printed
    assert "hand, thesis" in printed and "fit ms" in printed
    cases = json.loads((tmp_path / "b.json").read_text())["cases"]
    assert [(case["case"], case["tracker"], case["frames"]) for case in cases] == [
        ("hand", "model_based", 8), ("hand", "thesis", 8),
    ]  # fmt: skip
    assert cases[0]["keypoint_error_mm"]["mean"] < 8.0
    assert len(list((tmp_path / "p").glob("hand-model_based-*.png"))) == 3


def test_short_and_json_are_for_scripts(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(recording) as data:
        np.savez(tmp_path / "start.npz", pose=data["truth_pose"][0])
    start = ["--start", tmp_path / "start.npz", "--shape", "mean"]
    assert bench("sequence", "--sequence", recording, *start, "--format", "short") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    assert re.fullmatch(
        r"hand model_based: frames 8, mean mm [\d.]+, .*frames/s [\d.]+, .*", lines[0]
    )
    assert bench("--sequence", recording, "--quick", "--format", "json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["cases"][0]["case"] == "hand" and document["targets"] == []
    assert document["command"] == ("handtrack bench --sequence hand.npz --quick --device cpu")


def test_targets_are_told_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    # The exit code says that the measurement worked, not that the target was met.
    assert bench("selftest", "--quick", "--tracker", "thesis", "--format", "short") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert re.fullmatch(r"(PASS|MISS) selftest phalanx_error_mm.mean [\d.]+ <= 1", lines[1])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name a suite"),
        (["selftest", "--sequence", "x"], "only with it"),
        (["sequence"], "--sequence PATH"),
        (["--sequence", "nowhere.npz"], "nowhere.npz"),
        (["selftest", "--tracker", "oracle"], "model_based"),
        (["real"], "--data"),
        (["single-frame", "--tracker", "thesis"], "needs a first pose"),
        (["selftest", "--first-pose", "found"], "tracking does"),
        (["selftest", "--json", "none/x.json"], "is no folder"),
        (["races"], "selftest"),
    ],
)
def test_bad_usage_is_one_line_and_exit_code_2(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench(*words) == 2
    captured = capsys.readouterr()
    told = captured.err + captured.out
    assert message in told
    if words != ["races"]:  # tyro frames its own message
        assert captured.err.count("\n") == 1


def test_a_sequence_without_labels_asks_for_its_start(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(recording) as data:
        kept = {name: data[name] for name in data.files if not name.startswith("truth")}
    np.savez(tmp_path / "bare.npz", **kept)
    assert bench("--sequence", tmp_path / "bare.npz") == 2
    assert "--start" in capsys.readouterr().err


def test_first_poses_can_be_found_and_shapes_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from handtrack.evaluation.suites import suite

    seen = []

    def nothing(name: str, settings: suite.SuiteSettings) -> suite.SuiteResult:
        seen.append((name, settings))
        curves = suite.Curves(
            name="share", title="t", xlabel="x", ylabel="y", y_range=(0.0, 100.0),
            lines={"a": (np.array([0.0, 1.0]), np.array([0.0, 50.0]))},
        )  # fmt: skip
        case = {"case": "all", "tracker": "hybrid", "frames": 3, "within_1": 0.5}
        return suite.SuiteResult(suite=name, cases=[case], curves=[curves])

    monkeypatch.setattr(suite, "run_suite", nothing)
    words = ["--first-pose", "found", "--shape", "mean", "--curves", tmp_path / "c"]
    assert bench("tracking", *words, "--format", "json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["command"] == (
        "handtrack bench tracking --first-pose found --shape mean --device cpu"
    )
    assert bench("single-frame", "--quick", "--format", "short") == 0
    assert capsys.readouterr().out == "all hybrid: frames 3, back in 1 50.0%\n"
    (_, found), (name, own) = seen
    assert (found.first_pose, found.shape) == ("found", "mean")
    assert (name, own.first_pose, own.shape) == ("single-frame", "truth", None)
    # The suite's own curves, and none of errors that it does not have.
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["tracking-share.png"]


def test_help_names_every_suite(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--help"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in SUITES)
    assert "handtrack bench tracking --tracker model_based --tracker thesis" in printed
