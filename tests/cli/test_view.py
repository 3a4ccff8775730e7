"""`handtrack view`: what it asks of the loop, and what it says."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import pytest

from handtrack.cli import main
from handtrack.viewer.controls import Wishes
from handtrack.viewer.loop import TrackingLoop

pytest.importorskip("viser", reason="viser is not installed")


@pytest.fixture
def loops(monkeypatch: pytest.MonkeyPatch) -> list[tuple[TrackingLoop, Wishes, str]]:
    """Loops that only took the wishes and fetched the page, as if Ctrl-C came then."""
    met: list[tuple[TrackingLoop, Wishes, str]] = []

    def run(loop: TrackingLoop) -> None:
        url = getattr(loop._viewer, "url")  # noqa: B009 (only the web viewer has one)
        with urllib.request.urlopen(url, timeout=10) as answer:
            page = answer.read().decode("utf-8", "replace")
        met.append((loop, loop.controls.take(), page))
        loop._close()
        raise KeyboardInterrupt

    monkeypatch.setattr(TrackingLoop, "run", run)
    return met


def test_the_sample_is_shown_without_a_source(
    loops: list[tuple[TrackingLoop, Wishes, str]], capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "--port", "0", "--device", "cpu"]) == 0
    ((loop, wishes, page),) = loops
    assert loop.playback.length == 150
    assert wishes == Wishes(tracker="hybrid")
    assert "<html" in page.lower()
    said = capfd.readouterr()
    assert "http://127.0.0.1:" in said.out and "viser" not in said.out


def test_options_become_wishes(
    loops: list[tuple[TrackingLoop, Wishes, str]], tmp_path: Path
) -> None:
    words = ["--tracker", "pso", "--speed", "1/4", "--paused", "--once", "--port", "0"]
    assert main(["view", "data/demo.npz", *words, "--device", "cpu"]) == 0
    assert loops[0][1] == Wishes(tracker="pso", speed=0.25, paused=True, repeat=False)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["nothing/there"], "nothing/there"),
        (["--host", "no.such.host.invalid"], "cannot listen"),
        (["--port", "70000"], "port is 70000"),
    ],
)
def test_bad_usage_is_one_line(
    words: list[str], told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", *words, "--device", "cpu"]) == 2
    error = capfd.readouterr().err
    assert told in error and error.startswith("handtrack: error:") and error.count("\n") == 1
