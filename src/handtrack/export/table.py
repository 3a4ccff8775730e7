"""CSV: a row per frame, named columns with units; the layout of `results.csv`."""

from __future__ import annotations

import csv
import io

import numpy as np

from handtrack.evaluation.run_record import COLUMNS
from handtrack.export.track import Track


def table(track: Track) -> bytes:
    """Every frame; what is not known is an empty cell."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    numbers = np.concatenate(
        [
            track.depth_errors[:, None], track.poses,
            track.keypoints.reshape(len(track), -1), track.keypoint_std,
        ],
        axis=1,
    )  # fmt: skip
    for frame, time, state, row in zip(
        track.frames, track.times, track.states, numbers, strict=True
    ):
        cells = [f"{number:.7g}" if np.isfinite(number) else "" for number in row]
        writer.writerow([frame, f"{time:.6f}", state.value, *cells])
    return text.getvalue().encode("utf-8")
