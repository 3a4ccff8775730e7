import hashlib
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from handtrack import artifacts, optional
from handtrack.artifacts import artifact_files, artifact_path, artifact_root
from handtrack.camera.source import FORMATS, LIVE_SOURCES
from handtrack.cli import main
from handtrack.errors import MissingFileError


def test_json_tells_versions_devices_artifacts_and_formats(capsys):
    assert main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["versions"]["numpy"] == np.__version__
    assert "cpu" in facts["devices"]
    assert facts["devices"]["auto means"] in facts["devices"]
    assert facts["devices"]["kernel cache"]
    assert list(facts["sequence formats"]) == list(FORMATS)


def test_missing_extras_are_told_with_what_to_type(capsys, monkeypatch):
    monkeypatch.setitem(optional.EXTRAS, "rosbag", ("a_module_that_is_nowhere",))
    assert main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["extras"]["rosbag"] == "missing: pip install 'handtrack[rosbag]'"
    assert set(facts["extras"]) == set(optional.EXTRAS)
    assert facts["sequence formats"]["rosbag1"].endswith("[needs the extra rosbag]")
    assert "needs" not in facts["sequence formats"]["npz"]
    assert facts["live sources"] == LIVE_SOURCES
    assert main(["info"]) == 0
    printed = capsys.readouterr().out
    assert "pip install 'handtrack[rosbag]'" in printed and "[needs the extra rosbag]" in printed


def test_extras_are_those_of_the_distribution():
    project = Path(__file__).parents[2] / "pyproject.toml"
    told = tomllib.loads(project.read_text("utf-8"))["project"]["optional-dependencies"]
    assert set(optional.EXTRAS) <= set(told)


def test_artifacts_are_told_with_their_hash(capsys):
    main(["info", "--json"])
    told = json.loads(capsys.readouterr().out)["artifacts"]
    files = artifact_files()
    assert set(told) == {"folder", *(f.relative_to(artifact_root()).as_posix() for f in files)}
    for file in files:
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        assert digest[:16] in told[file.relative_to(artifact_root()).as_posix()]


def test_table_names_every_section_and_nothing_else_is_printed(capsys):
    assert main(["info"]) == 0
    captured = capsys.readouterr()
    for word in ("versions", "warp-lang", "devices", "artifacts", "kernel cache", "msra"):
        assert word in captured.out
    assert captured.err == ""


def test_artifacts_are_found_by_short_and_by_long_name(tmp_path, monkeypatch):
    packed = tmp_path / "_artifacts"
    (packed / "models").mkdir(parents=True)
    (packed / "data" / "demo").mkdir(parents=True)
    hand = packed / "models" / "hand.npz"
    hand.write_bytes(b"x")
    monkeypatch.setattr(artifacts, "_PACKAGE", tmp_path)
    assert artifact_root() == packed
    assert artifact_path("hand.npz") == artifact_path("models/hand.npz") == hand
    assert artifact_path("demo") == artifact_path("data/demo") == packed / "data" / "demo"
    assert artifact_files() == [hand]
    with pytest.raises(MissingFileError, match=r"forest\.npz.*models/hand\.npz"):
        artifact_path("forest.npz")


def test_without_packed_artifacts_the_checkout_is_used(tmp_path, monkeypatch):
    package = tmp_path / "src" / "handtrack"
    package.mkdir(parents=True)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "hand.npz").write_bytes(b"x")
    monkeypatch.setattr(artifacts, "_PACKAGE", package)
    assert artifact_path("hand.npz") == tmp_path / "models" / "hand.npz"


def test_nothing_is_written_to_stderr_on_a_machine_without_gpu(capfd):
    assert main(["info"]) == 0
    assert capfd.readouterr().err == ""
