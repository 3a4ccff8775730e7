"""Synthesise the sample sequence data/demo.npz: the one that `handtrack demo` tracks.

Usage: python data/make_demo.py [--out data/demo.npz]

A part of the retargeted motion in which the hand turns over, closes, pinches and points, worn by a
subject drawn from the population, with a forearm, seen by a time-of-flight camera.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from handtrack.camera.readers.npz import write_npz_sequence
from handtrack.hand.model import HandModel
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import TIME_OF_FLIGHT
from handtrack.synthesis.sequence import CAMERAS, synthesize_sequence

MOTION = "recorded_hand_motion"
FRAMES = slice(817, 967)
SUBJECT, SEED = 7, 1
"""Seeds of the subject and of the noise."""
RATE = 30.0
"""Frame rate the sequence is played at [1/s]; the recording does not tell its own."""
DEPTH_UNIT = 0.001
"""Step of the stored depth [m]: that of the modelled sensor."""


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "demo.npz")
    options = parser.parse_args()
    motion = Motion.load(MOTION).take(FRAMES.start, FRAMES.stop)
    model, camera = HandModel.load(), CAMERAS["creative"]
    shape = model.sample_shape(np.random.default_rng(SUBJECT))
    hand = model.shaped(shape)
    frames = list(
        synthesize_sequence(motion, hand, camera, TIME_OF_FLIGHT, seed=SEED, device="cpu")
    )
    truth = [frame.truth for frame in frames if frame.truth is not None]
    write_npz_sequence(
        options.out,
        [frame.depth for frame in frames],
        camera,
        depth_unit=DEPTH_UNIT,
        frames_per_second=RATE,
        time=np.arange(len(frames)) / RATE,
        truth_pose=[known.pose for known in truth],
        truth_keypoints=[known.keypoints for known in truth],
        side="right",
        shape_alpha=shape.alpha,
        shape_beta=shape.beta,
        scale=shape.scale,
        source=f"synthesised by handtrack from frames {FRAMES.start} to {FRAMES.stop - 1} of "
        f"{MOTION} ({motion.source}); subject {SUBJECT} and noise seed {SEED}",
        licence="Apache-2.0",
    )
    print(f"{options.out}: {len(frames)} frames, {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
