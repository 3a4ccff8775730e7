"""Writing a track: whole files, and one-line errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from handtrack.errors import InputError
from handtrack.export.formats import FORMATS, write_track
from handtrack.export.track import Track


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_is_written_as_a_whole(track: Track, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"hand.{name}"
    path.write_bytes(b"old")
    assert write_track(track, path, name) == path
    assert path.read_bytes() == FORMATS[name].encode(track)
    assert [other.name for other in tmp_path.iterdir()] == [path.name]


def test_bad_targets_are_refused(track: Track, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no format 'fbx': expected csv"):
        write_track(track, tmp_path / "hand.fbx", "fbx")
    for path in (tmp_path, tmp_path / "no" / "hand.csv", tmp_path / ("h" * 300)):
        with pytest.raises(InputError, match=r"cannot be written .*: name a file"):
            write_track(track, path, "csv")
    assert not list(tmp_path.iterdir())
