import os
import subprocess
import sys
import types

import pytest

import handtrack.cli as cli
from handtrack.errors import (
    DamagedFileError,
    DeviceError,
    InputError,
    MissingDependencyError,
    MissingFileError,
)


@pytest.fixture
def info_that(monkeypatch):
    """Replace what `handtrack info` does."""
    from handtrack.cli import info

    def replace(action):
        monkeypatch.setattr(info, "run", action)

    return replace


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["help"]])
def test_help_lists_every_command_that_is_there(words, capsys):
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    for verb in cli.available_verbs():
        assert f"  {verb} " in out
    assert "info" in cli.available_verbs()


def test_no_command_shows_the_help_as_bad_usage(capsys):
    assert cli.main([]) == cli.USAGE
    assert "commands:" in capsys.readouterr().out


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("handtrack ")


def test_unknown_command_is_one_line_that_lists_the_known_ones(capsys):
    assert cli.main(["trak"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("handtrack: error: no command 'trak'")
    assert "info" in error


@pytest.mark.parametrize("verb", cli.available_verbs())
def test_every_command_explains_itself_with_an_example(verb, capsys):
    assert cli.main([verb, "--help"]) == 0
    assert f"handtrack {verb}" in capsys.readouterr().out


def test_unknown_option_is_bad_usage(capsys):
    assert cli.main(["info", "--nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InputError("wrong\nvalue"), 2),
        (MissingFileError("wrong\nvalue"), 2),
        (DamagedFileError("wrong\nvalue"), 2),
        (DeviceError("wrong\nvalue"), 2),
        (MissingDependencyError("wrong\nvalue"), 1),
        (ZeroDivisionError("wrong\nvalue"), 1),
        (MemoryError("wrong\nvalue"), 1),
        (KeyboardInterrupt(), 130),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else str(value),
)
def test_errors_become_exit_codes_and_at_most_one_line(info_that, error, code, capsys):
    def fail(options):
        raise error

    info_that(fail)
    assert cli.main(["info"]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    if code != 130:
        assert captured.err.count("\n") == 1
        assert captured.err.startswith("handtrack: error: ")
        assert "wrong value" in captured.err


def test_traceback_is_shown_when_asked_for(info_that, capsys, monkeypatch):
    def fail(options):
        raise ZeroDivisionError("deep inside")

    info_that(fail)
    monkeypatch.setenv(cli.DEBUG_VARIABLE, "1")
    assert cli.main(["info"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_the_verbs_exit_code_is_passed_on(info_that):
    info_that(lambda options: 1)
    assert cli.main(["info"]) == 1


def test_verb_names_map_to_classes():
    module = types.SimpleNamespace(FitShapeOptions="found")
    assert cli.options_class("fit-shape", module) == "found"  # type: ignore[arg-type]


def test_reader_that_goes_away_is_not_an_error():
    code = (
        "import sys, handtrack.cli as cli, handtrack.cli.info as info\n"
        "def run(options):\n"
        "    for _ in range(100000): print('x' * 80)\n"
        "    return 0\n"
        "info.run = run\n"
        "sys.exit(cli.main(['info']))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(timeout=60) == 0


def test_help_imports_nothing_heavy():
    code = (
        "import sys, handtrack.cli as cli\n"
        "cli.main(['--help'])\n"
        "heavy = {'numpy', 'warp', 'cv2', 'tyro', 'scipy', 'rich'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=False
    )
    assert result.returncode == 0, result.stderr
