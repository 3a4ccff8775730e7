"""`handtrack live`: track a camera and show, publish, record what is found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from handtrack.cli.session import SessionOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.sequence import Sequence
    from handtrack.tracking.result import HandResult
    from handtrack.viewer.loop import Sink


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions(SessionOptions):
    """Track the hand before a depth camera and see it in a browser, as it happens.

    SOURCE is `realsense` (`realsense:SERIAL` for a certain one), `replay:PATH` for a recording
    played as if it was a camera, or a recording. Of frames that come faster than they are tracked
    the newest is taken; the others are counted as dropped.

    Examples::

        handtrack live
        handtrack live realsense --record recordings/today --publish 127.0.0.1:8765
        handtrack live replay:data/demo.npz --headless --publish 127.0.0.1:8765
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = "realsense"
    """Live source or recording."""
    publish: str | None = None
    """Stream every result as JSON over a WebSocket at HOST:PORT, or PORT of 127.0.0.1."""
    record: Path | None = None
    """Record every frame with its result into this folder."""
    headless: bool = False
    """No web page: only publish and record, until Ctrl-C or the end of a recording."""


def run(options: LiveOptions) -> int:
    """Track until Ctrl-C.

    Args:
        options: The command's options.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: The source or an option is unusable, or a package is missing.
    """
    # Imported here: `handtrack --help` need not wait for them.
    from contextlib import ExitStack

    from handtrack.cli.progress import counting
    from handtrack.cli.session import make_recorder, run_session
    from handtrack.viewer.controls import Wishes

    address = None if options.publish is None else parse_address(options.publish)
    with ExitStack() as stack:

        def make_sinks(sequence: Sequence, side: str) -> Iterator[Sink]:
            if address is not None:
                from handtrack.export.publisher import Publisher

                publisher = Publisher(*address)
                print(f"publishing at {publisher.url}", flush=True)
                yield publisher
            if options.record is not None:
                yield make_recorder(options.record, sequence, side)
            if options.headless:
                yield _Count(stack.enter_context(counting(None, "tracking")))

        wishes = Wishes(tracker=options.tracker, repeat=not options.headless)
        return run_session(
            options.source, options, wishes, headless=options.headless, make_sinks=make_sinks
        )


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, or of PORT alone.

    Raises:
        InputError: It is something else.
    """
    from handtrack.errors import InputError

    host, colon, port = text.rpartition(":")
    if not colon and port.isdecimal():
        from handtrack.export.publisher import HOST

        host, colon = HOST, ":"
    if not colon or not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise InputError(f"{text!r} is no address: expected HOST:PORT, such as 127.0.0.1:8765")
    return host.strip("[]"), int(port)


class _Count:
    """Shows in the terminal how many frames were tracked, and the last state."""

    def __init__(self, count: Callable[[int, str], None]) -> None:
        self._count, self._done = count, 0

    def frame(self, frame: DepthFrame, hand: HandResult) -> None:
        """Count one more."""
        del frame
        self._done += 1
        self._count(self._done, hand.state.value.replace("_", " "))

    def close(self) -> None:
        """Nothing is left to do."""
