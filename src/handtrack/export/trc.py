"""TRC: the 21 keypoints as markers for OpenSim and other biomechanics programs, in mm, y up."""

from __future__ import annotations

import numpy as np

from handtrack.export.axes import points_y_up
from handtrack.export.track import Track
from handtrack.hand.skeleton import KEYPOINTS


def trc(track: Track) -> bytes:
    """Every frame with its own time stamp; where the hand was not followed, cells are empty.

    The rate of the header is the mean one, for the format has no other; readers go by the times.
    """
    rate = f"{1.0 / track.interval:.6f}"
    count = str(len(track))
    markers = str(len(KEYPOINTS))
    header = {
        "DataRate": rate, "CameraRate": rate, "NumFrames": count, "NumMarkers": markers,
        "Units": "mm", "OrigDataRate": rate, "OrigDataStartFrame": "1", "OrigNumFrames": count,
    }  # fmt: skip
    axes = [f"{axis}{number}" for number in range(1, len(KEYPOINTS) + 1) for axis in "XYZ"]
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", "keypoints.trc"],
        list(header),
        list(header.values()),
        # A marker's name stands over its x, with two empty cells behind it.
        ["Frame#", "Time", *(cell for name in KEYPOINTS for cell in (name, "", ""))],
        ["", "", *axes],
        [],
    ]
    points = 1e3 * points_y_up(track.keypoints).reshape(len(track), -1)
    times = track.times - track.times[0]
    for place, (followed, time) in enumerate(zip(track.followed, times, strict=True)):
        row = points[place] if followed else np.full(points.shape[1], np.nan)
        cells = [f"{number:.5f}" if np.isfinite(number) else "" for number in row]
        lines.append([str(place + 1), f"{time:.6f}", *cells])
    return ("\n".join("\t".join(line) for line in lines) + "\n").encode("ascii")
