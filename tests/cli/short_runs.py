"""Short recordings to run verbs on, what tracking them gave, and Ctrl-C in the middle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.cli import main


def synthesise(path: Path, count: int, *more: str) -> Path:
    """Render the first frames of a motion into a file or folder."""
    words = ["synth", "recorded_hand_motion", "--frames", f"877:{877 + count}", *more]
    assert main([*words, "--out", str(path), "--device", "cpu"]) == 0
    return path


def results(folder: Path) -> dict[str, np.ndarray]:
    """Arrays of the results in a folder."""
    with np.load(folder / "results.npz", allow_pickle=False) as data:
        return dict(data)


def interrupt(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Let Ctrl-C come in a frame, counted from 1 over all sequences."""
    from handtrack.tracking.tracker import HandTracker

    original, calls = HandTracker.track, []

    def interrupted(self: HandTracker, depth: object) -> object:
        calls.append(1)
        if len(calls) == number:
            raise KeyboardInterrupt
        return original(self, depth)

    monkeypatch.setattr(HandTracker, "track", interrupted)
