"""Measurements that need a process of Python's to themselves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from handtrack.errors import HandtrackError


class OwnProcessError(HandtrackError, RuntimeError):
    """A script failed in its own process; the message is the last that it said."""


def run_script(
    script: str,
    words: Sequence[str],
    *,
    limit_seconds: float,
    variables: Mapping[str, str] | None = None,
) -> Any:
    """Run a script in a process of Python's that finds what this one finds.

    Args:
        script: Python source; its last line of output is JSON.
        words: Its arguments.
        limit_seconds: So long at most [s].
        variables: Environment variables that differ from those of this process.

    Returns:
        What the last line of output holds.

    Raises:
        OwnProcessError: The process failed, took too long, or printed something else.
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths, **(variables or {})}
    try:
        done = subprocess.run(
            [sys.executable, "-c", script, *words],
            capture_output=True, text=True, env=environment, timeout=limit_seconds, check=True,
        )  # fmt: skip
        return json.loads(done.stdout.strip().splitlines()[-1])
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["no message"])[-1]
        raise OwnProcessError(last) from error
    except (subprocess.TimeoutExpired, ValueError, IndexError, OSError) as error:
        raise OwnProcessError(str(error)) from error
