"""Draw overlay.png, the picture at the top of the README: four tracked frames of the sample.

Usage: python docs/pictures/make_overlay.py [--out docs/pictures/overlay.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import handtrack as ht
from handtrack.evaluation.curves import write_picture
from handtrack.viewer.pictures import OverlayPainter, PictureStyle, contact_sheet

FRAMES = (3, 48, 108, 142)
STYLE = PictureStyle(panel=(300, 300), zoom=0.27, text=False)


def main() -> None:
    """Track the sample, draw some of its frames."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "overlay.png")
    options = parser.parse_args()
    sample = Path(__file__).resolve().parents[2] / "data" / "demo.npz"
    pictures = []
    with ht.open_sequence(sample) as sequence:
        assert sequence.subject is not None
        shape = ht.HandShape(alpha=sequence.subject.alpha, beta=sequence.subject.beta)
        tracker = ht.HandTracker(sequence.camera, shape=shape)
        painter = OverlayPainter(tracker.hand, sequence.camera, style=STYLE)
        for frame in sequence:
            if frame.index == 0:
                tracker.reset(frame.truth.pose)
            hand = tracker.track(frame.depth)
            if frame.index in FRAMES:
                painter.cut()
                depth, overlay = np.hsplit(painter.paint_result(frame.depth, hand), 2)
                pictures.append(np.vstack([depth, np.full((4, 300, 3), 255, np.uint8), overlay]))
    write_picture(options.out, contact_sheet(pictures, len(pictures)))


if __name__ == "__main__":
    main()
