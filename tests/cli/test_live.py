"""`handtrack live`: replayed sources, recording, publishing, addresses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cli.short_runs import synthesise
from handtrack.camera.sequence import RecordedSequence
from handtrack.camera.source import open_sequence
from handtrack.cli import main
from handtrack.cli.live import parse_address
from handtrack.cli.session import explained
from handtrack.errors import InputError

COUNT = 6


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few synthesised frames of a subject."""
    return synthesise(tmp_path_factory.mktemp("live") / "hand.npz", COUNT)


def live(*words: object) -> int:
    return main(["live", *map(str, words), "--headless", "--device", "cpu"])


def test_a_recording_is_tracked_recorded_and_published_to_its_end(
    recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("websockets", reason="websockets is not installed")
    out = tmp_path / "again"
    assert live(recording, "--record", out, "--publish", "127.0.0.1:0") == 0
    said = capfd.readouterr()
    assert "publishing at ws://127.0.0.1:" in said.out
    assert f"{COUNT} frames tracked" in said.err
    with open_sequence(recording) as before, open_sequence(out) as after:
        assert isinstance(before, RecordedSequence) and isinstance(after, RecordedSequence)
        assert len(after) == len(before) == COUNT
        for one, other in zip(before, after, strict=True):
            np.testing.assert_allclose(other.depth, one.depth, atol=0.6e-4)


def test_a_folder_with_images_is_not_recorded_over(
    recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "000000.png").write_bytes(b"yesterday")
    assert live(recording, "--record", tmp_path) == 2
    assert "holds images already" in capfd.readouterr().err
    assert (tmp_path / "000000.png").read_bytes() == b"yesterday"


@pytest.mark.parametrize("text", ["here", "127.0.0.1:", ":8765", "host:port", "host:70000"])
def test_an_address_has_a_host_and_a_port(text: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="HOST:PORT"):
        parse_address(text)
    assert live("data/demo.npz", "--publish", text) == 2
    assert "HOST:PORT" in capfd.readouterr().err


def test_addresses_are_taken_apart() -> None:
    assert parse_address("127.0.0.1:8765") == ("127.0.0.1", 8765)
    assert parse_address("[::1]:80") == ("::1", 80)
    assert parse_address("8765") == ("127.0.0.1", 8765)


def test_a_slow_start_is_explained_and_a_quick_one_is_not(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import time

    with explained("loading"):
        pass
    assert capfd.readouterr().err == ""
    monkeypatch.setattr("handtrack.cli.session.PATIENCE", 0.01)
    with explained("loading"):
        time.sleep(0.3)
    assert "compiled on the first start" in capfd.readouterr().err
