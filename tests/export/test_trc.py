"""The .trc, read by the package trc-data-reader, and its layout as OpenSim expects it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.export.track import Track
from handtrack.export.trc import trc
from handtrack.hand.skeleton import KEYPOINTS

UPRIGHT = np.array([1.0, -1.0, -1.0])


@pytest.fixture
def path(track: Track, tmp_path: Path) -> Path:
    path = tmp_path / "hand.trc"
    path.write_bytes(trc(track))
    return path


def test_another_reader_finds_the_same_markers(path: Path, track: Track) -> None:
    reader = pytest.importorskip(
        "trc", reason="trc-data-reader, which reads .trc independently, is not installed"
    )
    data = reader.TRCData()
    data.load(str(path))
    assert data["Units"] == "mm" and data["NumFrames"] == len(track)
    assert data["Markers"] == list(KEYPOINTS)
    np.testing.assert_allclose(data["Time"], track.times - track.times[0], atol=1e-6)
    for place, name in enumerate(KEYPOINTS):
        found = np.array(data[name])
        expected = 1e3 * track.keypoints[:, place] * UPRIGHT
        followed = track.followed
        assert np.abs(found[followed] - expected[followed]).max() < 1e-3  # mm
        assert np.isnan(found[~followed]).all()


def test_the_layout_is_the_published_one(path: Path, track: Track) -> None:
    lines = path.read_text("ascii").splitlines()
    assert lines[0].startswith("PathFileType\t4\t(X/Y/Z)\t")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert header["NumMarkers"] == "21" and header["Units"] == "mm"
    assert float(header["DataRate"]) == pytest.approx(1.0 / track.interval, abs=1e-5)
    names = lines[3].split("\t")
    assert names[:2] == ["Frame#", "Time"] and names[2::3] == list(KEYPOINTS)
    assert lines[4].split("\t")[2:8] == ["X1", "Y1", "Z1", "X2", "Y2", "Z2"]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:]]
    assert [row[0] for row in rows] == [str(k + 1) for k in range(len(track))]
    assert {len(row) for row in rows} == {2 + 3 * 21}
    assert {"" in row[2:] for row, good in zip(rows, track.followed, strict=True) if good} == {
        False
    }
