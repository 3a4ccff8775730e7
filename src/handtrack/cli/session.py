"""What `handtrack view` and `handtrack live` share: source, hand, trackers, web page, loop."""

from __future__ import annotations

import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from handtrack.cli.track import TrackerName

if TYPE_CHECKING:
    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.recorder import Recorder
    from handtrack.camera.sequence import Sequence
    from handtrack.cli.first_pose import Pose
    from handtrack.hand.model import HandModel
    from handtrack.tracking.tracker import HandTracker
    from handtrack.viewer.controls import Controls, Wishes
    from handtrack.viewer.loop import Sink
    from handtrack.viewer.playback import Playback
    from handtrack.viewer.web import WebViewer

PATIENCE = 2.5
"""A start that takes longer than this [s] is explained."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionOptions:
    """Options of commands that track while somebody looks."""

    tracker: TrackerName = "hybrid"
    """Which tracker at first; the page can switch."""
    shape: str | None = None
    """Hand shape: an .npz file, or mean; without it that of the sequence when it carries one."""
    side: Literal["right", "left"] | None = None
    """Which hand; without it what the sequence says, else right."""
    host: str = "127.0.0.1"
    """Address of the web page; who can reach it can see and press everything."""
    port: int = 8080
    """Port that is tried first, then those above it; 0 takes any."""
    open: bool = False
    """Open the page in this machine's browser."""
    recordings: Path = Path("recordings")
    """Folder under which the page's record button puts recordings."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of whatever is random."""


def run_session(
    source: str,
    options: SessionOptions,
    wishes: Wishes,
    *,
    headless: bool = False,
    make_sinks: Callable[[Sequence, str], Iterator[Sink]] = lambda sequence, side: iter(()),
) -> int:
    """Track a source until Ctrl-C, or until it ends and nobody looks.

    Args:
        source: What `open_sequence` opens.
        options: The command's options.
        wishes: What the user wants at first.
        headless: No web page.
        make_sinks: Makes, from the open source and the side, what takes every tracked frame.

    Returns:
        Exit code 0.

    Raises:
        HandtrackError: The source or an option is unusable, or a package is missing.
    """
    from handtrack.camera.source import open_sequence
    from handtrack.cli import compute_device
    from handtrack.cli.first_pose import first_labelled
    from handtrack.cli.track import choose_shape, choose_side
    from handtrack.hand.model import HandModel
    from handtrack.tracking.tracker import HandTracker
    from handtrack.viewer.controls import Controls
    from handtrack.viewer.loop import TrackingLoop
    from handtrack.viewer.playback import Playback
    from handtrack.viewer.viewer import NullViewer, Viewer

    with open_sequence(source) as sequence:
        model = HandModel.load()
        side = choose_side(options.side, sequence)
        shape, _ = choose_shape(options.shape, sequence, first_labelled(sequence), model, side)
        device = compute_device(options.device)

        def make_tracker(name: str) -> HandTracker:
            with explained("loading the tracker"):
                return HandTracker(
                    sequence.camera, side=side, shape=shape, device=device.alias, model=model,
                    tracker=name, seed=options.seed,
                )  # fmt: skip

        playback, controls = Playback(sequence), Controls(wishes)
        viewer: Viewer = NullViewer()
        sinks: list[Sink] = []
        try:
            sinks.extend(make_sinks(sequence, side))
            if not headless:
                viewer = _open_page(options, controls, playback)
            loop = TrackingLoop(
                playback, make_tracker, controls, viewer=viewer, sinks=sinks,
                make_recorder=lambda: make_recorder(
                    options.recordings / f"{datetime.now():%Y-%m-%d_%H-%M-%S}", sequence, side
                ),
                first_pose=_labelled_poses(model), linger=not headless, device=device.alias,
            )  # fmt: skip
        except BaseException:
            for end in (*sinks, viewer):
                end.close()
            raise
        try:
            loop.run()
        except KeyboardInterrupt:
            pass
        print(f"{loop.count} frames tracked", file=sys.stderr)
    return 0


def make_recorder(folder: Path, sequence: Sequence, side: str) -> Recorder:
    """A recorder of a source's frames.

    Args:
        folder: Where to.
        sequence: The source.
        side: Whose hand it is.
    """
    from handtrack.camera.recorder import Recorder

    return Recorder(
        folder, sequence.camera, frames_per_second=sequence.frames_per_second, side=side
    )


def _open_page(options: SessionOptions, controls: Controls, playback: Playback) -> WebViewer:
    """Start the web page, and say where it is."""
    from handtrack.tracking.tracker import TRACKERS
    from handtrack.viewer.web import WebViewer

    page = WebViewer(
        controls, trackers=tuple(TRACKERS), length=playback.length, live=playback.live,
        can_record=True, host=options.host, port=options.port,
    )  # fmt: skip
    print(f"{playback.sequence.name}: {page.url} (Ctrl-C ends)", flush=True)
    if options.open:
        webbrowser.open(page.url)
    return page


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Say what is going on when it takes a while, as kernels that compile do on a first start."""
    done = threading.Event()

    def explain() -> None:
        if not done.wait(PATIENCE):
            print(
                f"handtrack: {what}: kernels are compiled on the first start, which takes about a "
                "minute; later starts take seconds",
                file=sys.stderr, flush=True,
            )  # fmt: skip

    thread = threading.Thread(target=explain, name="handtrack-patience", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _labelled_poses(model: HandModel) -> Callable[[DepthFrame, HandTracker], Pose | None]:
    """What tells the pose in a frame: its labels, as far as it has any."""
    from handtrack.cli.first_pose import labelled_pose, tells_pose

    def first_pose(frame: DepthFrame, tracker: HandTracker) -> Pose | None:
        if frame.truth is None or not tells_pose(frame.truth):
            return None
        return labelled_pose(frame.truth, tracker.hand, model)

    return first_pose
