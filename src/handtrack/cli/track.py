"""`handtrack track`: follow the hand through sequences and save the results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.sequence import Sequence
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape

TrackerName = Literal["hybrid", "thesis_hybrid", "discriminative", "model_based", "thesis", "pso"]
"""Names in `handtrack.tracking.tracker.TRACKERS`, which is not imported for the help text."""

FormatName = Literal[
    "npz", "nyu", "msra", "icvl", "hands17", "dexter1", "realsense", "rosbag1", "rosbag2", "mcap",
    "png",
]  # fmt: skip
"""Names in `handtrack.camera.source.FORMATS`."""

_MEAN_HAND = "mean hand"
"""Where a shape comes from that nobody gave."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOptions:
    """Track the hand in depth sequences; write results.npz, results.csv, config.json.

    SOURCE is an .npz recording, a folder of 16-bit PNG images with camera.json, a data set, a ROS
    bag, an MCAP file, a RealSense recording (docs/formats.md), or a camera: realsense, which runs
    until Ctrl-C. The hand is found without being told where it is; trackers that cannot do that
    take the first pose from the labels of the sequence, or from --start.

    Of several sources each gets a folder of its own below --out. One that fails is told at the end
    and does not stop the others; the exit code is 1 then.

    Examples::

        handtrack track data/demo.npz --out out/demo --video
        handtrack track recording/ --out out/run --side left --shape me.npz
        handtrack track realsense --out out/today --record recordings/today
        handtrack track recordings/* --out out/all --jobs 4 --resume
        handtrack track recordings/* --out out/all --dask tcp://scheduler:8786
    """

    source: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE...")]
    """Sequences: files, folders, or realsense."""
    out: Path
    """Folder for the results; made when it does not exist."""
    video: bool = False
    """Write overlay.mp4 too: mesh and keypoints over the depth."""
    zoom: float | None = None
    """Let the video show so many metres around the hand instead of the whole image."""
    tracker: TrackerName = "hybrid"
    """Which tracker: hybrid finds and follows the hand; the others are baselines."""
    shape: str | None = None
    """Hand shape: an .npz file, or mean; without it that of the sequence when it carries one."""
    adapt_shape: bool = False
    """Find the whole shape of the hand on the way, beginning with that one; results hold it."""
    side: Literal["right", "left"] | None = None
    """Which hand; without it what the sequence says, else right."""
    start: str = "auto"
    """First pose: auto (none for trackers that find the hand, else truth), truth (the labels of the
    sequence), or a .json or .npz file with 28 numbers."""
    format: FormatName | None = None
    """Format of the sequence, told from its content when not given."""
    topic: str | None = None
    """Depth topic of a ROS bag or MCAP file that has several."""
    frames: int | None = None
    """Stop after so many frames."""
    record: Path | None = None
    """Record the frames into this new folder too, as PNG images; for one source."""
    jobs: int = 1
    """Processes that track several sequences."""
    dask: str | None = None
    """Address of a Dask scheduler whose workers track the sequences instead; they must see the same
    folders."""
    resume: bool = False
    """Leave out sequences whose results are there, complete and of the same options."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of whatever is random."""


def run(options: TrackOptions) -> int:
    """Track, print, write.

    Args:
        options: The command's options.

    Returns:
        Exit code: 0; 1 when some of several sequences failed; 130 when a recording was interrupted
        (what was tracked by then is written).

    Raises:
        HandtrackError: The sequence or an option is unusable.
    """
    from handtrack.cli import INTERRUPTED
    from handtrack.errors import InputError

    if options.jobs < 1:
        raise InputError(f"--jobs is {options.jobs}: expected 1 or more")
    if options.frames is not None and options.frames < 1:
        raise InputError(f"--frames is {options.frames}: expected 1 or more")
    if len(options.source) > 1 or options.jobs > 1 or options.dask is not None:
        from handtrack.cli.track_many import track_many

        return track_many(options)
    from handtrack.cli.track_sequence import is_done, print_table, track_sequence

    if not options.source:
        raise InputError("name what to track: handtrack track SOURCE --out FOLDER")
    source = options.source[0]
    if options.resume and is_done(options, source, options.out):
        print(f"{options.out} holds the results already: nothing to do")
        return 0
    tracked = track_sequence(options, source, options.out)
    print_table(options, options.out, tracked)
    # A live source ends by Ctrl-C, which is no accident.
    return INTERRUPTED if tracked.interrupted and not tracked.live else 0


def choose_side(wanted: str | None, sequence: Sequence) -> str:
    """Which hand it is: the one that is asked for, else what the sequence says, else right."""
    told = sequence.subject.side if sequence.subject else None
    return wanted or told or "right"


def choose_shape(
    wanted: str | None,
    sequence: Sequence,
    labelled: DepthFrame | None,
    model: HandModel,
    side: str,
) -> tuple[HandShape | None, str]:
    """Shape of the hand, None for the mean hand, and where it comes from in words.

    Args:
        wanted: "mean", a file, or None for what the sequence tells.
        sequence: The sequence.
        labelled: Its first labelled frame.
        model: The hand model.
        side: "right" or "left".
    """
    import numpy as np

    from handtrack.cli.first_pose import labelled_scale
    from handtrack.hand.shape import HandShape

    if wanted == "mean":
        return None, _MEAN_HAND
    if wanted is not None:
        return HandShape.load(wanted), wanted
    subject = sequence.subject
    if subject is not None and (subject.alpha is not None or subject.scale is not None):
        nothing = np.zeros(0)
        shape = HandShape(
            alpha=nothing if subject.alpha is None else subject.alpha,
            beta=nothing if subject.beta is None else subject.beta,
            scale=1.0 if subject.scale is None else subject.scale,
        )
        return shape, "from the sequence"
    if labelled is not None and labelled.truth is not None:
        scale = labelled_scale(labelled.truth, model, side)
        if scale != 1.0:
            return HandShape(scale=scale), f"mean hand, {scale:.3f} times as large (labels)"
    return None, _MEAN_HAND
