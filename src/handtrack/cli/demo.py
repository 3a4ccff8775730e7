"""`handtrack demo`: track the sample sequence that comes with handtrack."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handtrack.cli.track import TrackerName

SAMPLE = "data/demo.npz"
"""The sample sequence (data/README.md)."""
ZOOM = 0.45
"""Width of the video's view at the hand's distance [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """Track the sample sequence that comes with handtrack, print a table, write the results.

    Examples::

        handtrack demo --video
        handtrack demo --out /tmp/demo --tracker thesis
    """

    out: Path = Path("out/demo")
    """Folder for the results; made when it does not exist."""
    video: bool = False
    """Write overlay.mp4 too: mesh and keypoints over the depth."""
    tracker: TrackerName = "hybrid"
    """Which tracker."""
    device: str = "auto"
    """auto, cpu or cuda:0."""
    seed: int = 0
    """Seed of whatever is random."""


def run(options: DemoOptions) -> int:
    """Track the sample.

    Args:
        options: The command's options.

    Returns:
        Exit code of `handtrack track`.

    Raises:
        HandtrackError: The sample is missing, or an option is unusable.
    """
    # Imported here: `handtrack --help` need not wait for them.
    from handtrack.artifacts import artifact_path
    from handtrack.cli import track

    return track.run(
        track.TrackOptions(
            source=(str(artifact_path(SAMPLE)),),
            out=options.out,
            video=options.video,
            zoom=ZOOM,
            tracker=options.tracker,
            device=options.device,
            seed=options.seed,
        )
    )
