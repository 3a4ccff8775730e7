"""`handtrack track` over many sequences: processes, a Dask cluster, failures, going on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from cli.short_runs import interrupt, results, synthesise
from handtrack.cli import main, track_many
from handtrack.cli.track import TrackOptions
from handtrack.errors import InputError

COUNT = 4


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short synthesised recording."""
    return synthesise(tmp_path_factory.mktemp("many") / "hand.npz", COUNT, "--subject", "3")


@pytest.fixture
def sources(sequence: Path, tmp_path: Path) -> list[Path]:
    """Three of them, in folders of their own."""
    folder = tmp_path / "recordings"
    for name in ("a", "b", "c"):
        (folder / name).mkdir(parents=True)
        shutil.copy(sequence, folder / name / "sequence.npz")
    return sorted(folder.iterdir())


def track(sources: list[Path], out: Path, *more: str) -> int:
    words = ["track", *map(str, sources), "--out", str(out), "--device", "cpu"]
    return main([*words, "--tracker", "model_based", *more])


def written(out: Path) -> list[str]:
    """All files below a folder, hidden ones too."""
    return sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())


FILES = ("config.json", "results.csv", "results.npz")


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_each_sequence_gets_the_results_it_gets_alone(
    sources: list[Path], tmp_path: Path, jobs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert track(sources[:1], tmp_path / "alone") == 0
    capsys.readouterr()
    assert track(sources, tmp_path / "out", "--jobs", jobs) == 0
    assert written(tmp_path / "out") == [f"{name}/{file}" for name in "abc" for file in FILES]
    alone = results(tmp_path / "alone")
    for name in "abc":
        np.testing.assert_array_equal(results(tmp_path / "out" / name)["pose"], alone["pose"])
    printed = capsys.readouterr()
    assert printed.out.count("│ done") == 3 and not printed.err


def test_a_failure_is_told_at_the_end_and_stops_nothing(
    sources: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (sources[0] / "sequence.npz").write_bytes(b"PK\x03\x04 damaged")
    missing = tmp_path / "nowhere"
    assert track([*sources, missing], tmp_path / "out") == 1
    assert written(tmp_path / "out") == [f"{name}/{file}" for name in "bc" for file in FILES]
    printed = capsys.readouterr().out
    assert "2 of 4 sequences failed" in printed
    tail = printed[printed.index("sequences failed") :].splitlines()
    assert "a: " in tail[1] and "sequence.npz" in tail[1]
    assert "nowhere: no file or folder" in tail[2]


def test_what_is_done_is_left_out_unless_something_else_is_asked_for(
    sources: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert track(sources[:2], out) == 0
    (out / "b" / "results.csv").unlink()
    config = out / "a" / "config.json"
    before = config.stat().st_mtime_ns
    capsys.readouterr()
    assert track(sources, out, "--resume") == 0
    assert config.stat().st_mtime_ns == before
    printed = capsys.readouterr().out
    assert printed.count("│ skipped") == 1 and printed.count("│ done") == 2
    assert written(out) == [f"{name}/{file}" for name in "abc" for file in FILES]
    assert track(sources[:2], out, "--resume", "--seed", "5") == 0
    assert config.stat().st_mtime_ns > before


def test_results_of_an_interrupted_run_are_not_taken_for_done(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(monkeypatch, COUNT + 2)
    assert track(sources, tmp_path / "out") == 130
    facts = [json.loads((tmp_path / "out" / n / "config.json").read_text()) for n in "ab"]
    assert [fact["complete"] for fact in facts] == [True, False]
    assert not (tmp_path / "out" / "c").exists()
    assert track(sources, tmp_path / "out", "--resume") == 0
    assert len(results(tmp_path / "out" / "b")["pose"]) == COUNT


def test_one_source_can_go_on_too(sequence: Path, tmp_path: Path, capsys) -> None:
    assert track([sequence], tmp_path / "out") == 0
    assert track([sequence], tmp_path / "out", "--resume") == 0
    assert "nothing to do" in capsys.readouterr().out


def test_folders_are_named_by_what_tells_sources_apart(tmp_path: Path) -> None:
    def names(*sources: str) -> list[str]:
        paths = [tmp_path / source for source in sources]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch() if path.suffix else path.mkdir(exist_ok=True)
        options = TrackOptions(source=tuple(map(str, paths)), out=tmp_path / "out")
        return [task.name for task in track_many.make_tasks(options)]

    assert names("x/one.npz", "x/two.npz") == ["one", "two"]
    assert names("P0/tip", "P1/tip") == ["P0_tip", "P1_tip"]
    assert names("y/hand.npz", "y/hand") == ["hand.npz", "hand"]
    with pytest.raises(InputError, match="named twice"):
        names("P0/tip", "P0/../P0/tip")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--record", "r"], "--record goes with one source"),
        (["--jobs", "0"], "--jobs is 0"),
        (["--frames", "0"], "--frames is 0"),
    ],
)
def test_what_does_not_go_together_is_refused(
    sources: list[Path], tmp_path: Path, capsys, more: list[str], message: str
) -> None:
    assert track(sources, tmp_path / "out", *more) == 2
    assert message in capsys.readouterr().err


def test_a_live_source_is_tracked_alone(sequence: Path, tmp_path: Path, capsys) -> None:
    assert main(["track", f"replay:{sequence}", str(sequence), "--out", str(tmp_path)]) == 2
    assert "is live" in capsys.readouterr().err


DEADLY = "deadly"


def deadly_task(options: TrackOptions, task: track_many.Task) -> track_many.Outcome:
    """A stand-in for tracking whose process dies with one of the sequences."""
    if task.name == DEADLY:
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGKILL)
    return track_many.Outcome(name=task.name, state="done", frames=1)


def test_a_process_that_dies_takes_only_its_sequence_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(track_many, "run_task", deadly_task)
    names = ["one", DEADLY, "two", "three"]
    for name in names:
        (tmp_path / name).mkdir()
    assert track([tmp_path / name for name in names], tmp_path / "out", "--jobs", "2") == 1
    printed = capsys.readouterr().out
    assert f"{DEADLY}: its process was killed" in printed and printed.count("│ done") == 3


@pytest.mark.slow
def test_a_dask_cluster_gives_every_result_once_though_a_worker_is_killed(
    sources: list[Path], sequence: Path, tmp_path: Path, capsys
) -> None:
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install 'handtrack[cluster]'"
    )
    for number in range(3):
        folder = tmp_path / "recordings" / f"more{number}"
        folder.mkdir()
        shutil.copy(sequence, folder / "sequence.npz")
    sources = sorted((tmp_path / "recordings").iterdir())
    out = tmp_path / "out"
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        processes = client.run(os.getpid)
        killed = []

        def kill_when_half_is_done() -> None:
            while len(list(out.glob("*/config.json"))) < len(sources) // 2:
                time.sleep(0.02)
            killed.append(next(iter(processes.values())))
            os.kill(killed[0], signal.SIGKILL)

        import threading

        killer = threading.Thread(target=kill_when_half_is_done, daemon=True)
        killer.start()
        assert track(sources, out, "--dask", cluster.scheduler_address) == 0
        killer.join(timeout=1.0)
        assert killed and killed[0] not in client.run(os.getpid).values()
    assert written(out) == [f"{source.name}/{file}" for source in sources for file in FILES]
    reference = results(out / "a")["pose"]
    for source in sources:
        found = results(out / source.name)
        np.testing.assert_array_equal(found["frame_index"], np.arange(COUNT))
        np.testing.assert_array_equal(found["pose"], reference)
    assert capsys.readouterr().out.count("│ done") == len(sources)


def test_a_scheduler_that_is_not_there_is_told(sequence: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("distributed", reason="distributed is not installed")
    words = ["--dask", "tcp://127.0.0.1:9"]
    assert track([sequence], tmp_path / "out", *words) == 2
    printed = capsys.readouterr().err
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in printed
