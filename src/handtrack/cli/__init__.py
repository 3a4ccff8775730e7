"""The `handtrack` command: one file per verb, imported only when that verb is chosen.

A verb is a module of this package with a frozen dataclass named after it (`track` ->
`TrackOptions`, `fit-shape` -> `FitShapeOptions`), whose docstring and field docstrings are the help
text, and a function ``run(options) -> int`` that returns the exit code. `VERBS` names them all. A
verb that computes has an option `device` and hands it to `compute_device`.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import warp as wp

VERBS: dict[str, str] = {
    "demo": "track the sample sequence, print a table, write a video",
    "track": "track a recorded sequence and save the results",
    "view": "track a recording and look at it in a browser",
    "live": "track a camera; show, publish and record as it happens",
    "export": "write results for animation, virtual reality, biomechanics, spreadsheets",
    "fit-shape": "fit the hand model to its owner from a few depth images",
    "grasp": "plan how a hand takes an object, and carry it out under physics",
    "synth": "render labelled depth sequences from recorded motion",
    "train-forest": "train the regressor that starts and recovers tracking",
    "bench": "measure accuracy and speed together",
    "eval": "compare predictions with labels by a published protocol",
    "info": "versions, devices, artifacts: what to put into a bug report",
}
"""Verb -> what it does, in the order of the help text."""

USAGE = 2
"""Exit code for bad usage or input."""
FAILURE = 1
"""Exit code for a failure that is not the user's."""
INTERRUPTED = 130
"""Exit code after Ctrl-C."""
DEBUG_VARIABLE = "HANDTRACK_DEBUG"
"""Environment variable that shows the traceback of an error."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after `handtrack`; None takes them from the process.

    Returns:
        Exit code: 0, or `USAGE`, `FAILURE`, `INTERRUPTED`.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(help_text())
        return 0 if words else USAGE
    if words[0] in ("-V", "--version"):
        from handtrack import __version__

        print(f"handtrack {__version__}")
        return 0
    if words[0] not in available_verbs():
        return _complain(f"no command {words[0]!r}: expected {', '.join(available_verbs())}", USAGE)
    return _run(words[0], words[1:])


def available_verbs() -> list[str]:
    """Verbs of `VERBS` whose module is installed."""
    return [verb for verb in VERBS if find_spec(_module_name(verb)) is not None]


def help_text() -> str:
    """What `handtrack --help` prints; nothing heavy is imported for it."""
    lines = [
        "usage: handtrack COMMAND [options]",
        "",
        "Articulated 3D hand pose from one depth camera.",
        "",
        "commands:",
        *(f"  {verb:<13} {VERBS[verb]}" for verb in available_verbs()),
        "",
        "options:",
        "  --help        this text; after a command, its options with an example",
        "  --version     version of handtrack",
        "",
        "example: handtrack demo --video",
    ]
    return "\n".join(lines)


def options_class(verb: str, module: ModuleType) -> type:
    """The dataclass of a verb's options."""
    return getattr(module, "".join(part.title() for part in verb.split("-")) + "Options")


def compute_device(name: str) -> wp.Device:
    """The device of the option ``--device auto|cpu|cuda:0``, with Warp kept from chatting.

    Raises:
        DeviceError: There is no such device here.
    """
    import warp as wp

    from handtrack.device import resolve_device

    wp.config.log_level = wp.LOG_ERROR
    # Warp's native part warns on stderr when there is no CUDA driver, whatever its log level; on a
    # machine without a GPU that is no news.
    with _native_stderr_closed():
        wp.init()
    return resolve_device(name)


@contextlib.contextmanager
def _native_stderr_closed() -> Iterator[None]:
    """Send what C code writes to stderr nowhere."""
    sys.stderr.flush()
    with contextlib.ExitStack() as undo:
        kept = os.dup(2)
        undo.callback(os.close, kept)
        undo.callback(os.dup2, kept, 2)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        undo.callback(os.close, nowhere)
        os.dup2(nowhere, 2)
        yield


def _module_name(verb: str) -> str:
    """Module that implements a verb."""
    return f"handtrack.cli.{verb.replace('-', '_')}"


def _run(verb: str, words: list[str]) -> int:
    """Parse a verb's options, run it, and turn errors into exit codes."""
    from handtrack.errors import (
        DamagedFileError,
        DeviceError,
        HandtrackError,
        InputError,
        MissingFileError,
    )

    try:
        import tyro

        module = import_module(_module_name(verb))
        kind = options_class(verb, module)
        options = tyro.cli(
            kind,
            description=(inspect.getdoc(kind) or "").replace("::\n\n", ":\n"),
            prog=f"handtrack {verb}",
            args=words,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        code = int(module.run(options))
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # tyro: 0 after --help, 2 after bad usage
        return stop.code if isinstance(stop.code, int) else USAGE
    except (InputError, MissingFileError, DamagedFileError, DeviceError) as error:
        return _complain(error, USAGE)
    except HandtrackError as error:
        return _complain(error, FAILURE)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has gone (`handtrack ... | head`). Python flushes stdout once
        # more when it exits: let it write to nowhere.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        return _complain(
            f"unexpected {type(error).__name__}: {error} (set {DEBUG_VARIABLE}=1 to see where)",
            FAILURE,
        )


def _complain(problem: object, code: int) -> int:
    """Print one line on stderr and return the exit code."""
    if os.environ.get(DEBUG_VARIABLE):
        traceback.print_exc()
    print(f"handtrack: error: {' '.join(str(problem).split())}", file=sys.stderr)
    return code
