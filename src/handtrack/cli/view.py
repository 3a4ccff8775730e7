"""`handtrack view`: track a recording and look at it in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from handtrack.cli.session import SessionOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptions(SessionOptions):
    """Track a recording and look at it in a browser: depth image, 3D scene, state, timings.

    The page has buttons to pause, step, scrub and change the speed, to switch between trackers, to
    see the hypotheses, to record and to take a screenshot. Ctrl-C ends.

    Examples::

        handtrack view
        handtrack view recording/ --side left --speed 1/4 --paused
    """

    source: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """Recorded sequence: file or folder; without it the sample that comes with handtrack."""
    speed: Literal["1/10", "1/4", "1/2", "1", "2", "4", "fastest"] = "1"
    """Speed at first, as a multiple of the recording's own."""
    paused: bool = False
    """Wait at the first frame."""
    once: bool = False
    """Pause at the end instead of going on from the start."""


def run(options: ViewOptions) -> int:
    """Show the recording until Ctrl-C.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: The recording or an option is unusable, or viser is not installed.
    """
    # Imported here: `handtrack --help` need not wait for them.
    from handtrack.artifacts import artifact_path
    from handtrack.cli.demo import SAMPLE
    from handtrack.cli.session import run_session
    from handtrack.viewer.controls import SPEEDS, Wishes

    source = options.source if options.source is not None else str(artifact_path(SAMPLE))
    wishes = Wishes(
        tracker=options.tracker, paused=options.paused, speed=SPEEDS[options.speed],
        repeat=not options.once,
    )  # fmt: skip
    return run_session(source, options, wishes)
