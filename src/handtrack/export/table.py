"""CSV: a row per frame, named columns with units; the layout of `results.csv`."""

from __future__ import annotations

from handtrack.evaluation.run_record import csv_table
from handtrack.export.track import Track


def table(track: Track) -> bytes:
    """Every frame; what is not known is an empty cell."""
    return csv_table(
        track.frames, track.times, track.states, track.depth_errors, track.poses,
        track.keypoints, track.keypoint_std,
    )  # fmt: skip
