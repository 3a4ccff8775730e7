import importlib.util
from pathlib import Path

import pytest

PATH = Path(__file__).resolve().parents[2] / "tools" / "check_large_files.py"
_spec = importlib.util.spec_from_file_location("check_large_files", PATH)
assert _spec is not None
assert _spec.loader is not None
check_large_files = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_large_files)


@pytest.mark.parametrize(
    ("name", "megabytes", "fine"),
    [
        ("models/forest.npz", 39, True),
        ("models/forest.npz", 41, False),
        ("models/other.npz", 1, False),
        ("data/demo.npz", 2.9, True),
        ("data/deep/er.npz", 3.1, False),
        ("src/handtrack/errors.py", 0.1, True),
        ("notes.bin", 0.6, False),
    ],
)
def test_each_place_has_its_limit(name, megabytes, fine):
    assert (check_large_files.problem_with(name, int(megabytes * 1e6)) is None) == fine


def test_the_command_fails_for_a_large_file(tmp_path, capsys):
    path = tmp_path / "large.bin"
    path.write_bytes(bytes(600_000))
    assert check_large_files.main([str(path)]) == 1
    assert "large.bin has 0.6 MB" in capsys.readouterr().out
    assert check_large_files.main([__file__]) == 0
