"""Make the videos of docs/videos: depth, overlay and side view of tracked sequences.

The sample, and two synthesised sequences of subjects whose size the tracker is not told, with
forearm and sensor noise. Nothing is given to the tracker but the camera and the side.

Usage: python tools/make_videos.py [--out docs/videos] [--device cpu]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import handtrack as ht
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.sequence import CAMERAS, synthesize_sequence
from handtrack.tracking.result import TrackState
from handtrack.viewer.pictures import OverlayPainter, PictureStyle
from handtrack.viewer.side_view import SidePainter, SideStyle
from handtrack.viewer.video import VideoWriter

PANEL = (240, 240)
EVERY = 2
"""Every so many tracked frames one goes into the video."""
RATE = 15.0
"""Frames per second of the video: real time, for sources of 30."""
QUALITY = 55


@dataclass(frozen=True, slots=True, kw_only=True)
class Synthesised:
    """A piece of a recorded motion on a drawn subject."""

    motion: str
    frames: slice
    subject: int
    noise: str
    side: str


SYNTHESISED = {
    "synthesised_right": Synthesised(
        motion="recorded_hand_motion", frames=slice(270, 390), subject=7, noise="time_of_flight",
        side="right",
    ),
    "synthesised_left": Synthesised(
        motion="leap_hand_motion", frames=slice(0, 120), subject=12, noise="coded_light",
        side="left",
    ),
}  # fmt: skip


def main() -> None:
    """Make all videos."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    root = Path(__file__).resolve().parents[1]
    parser.add_argument("--out", type=Path, default=root / "docs" / "videos")
    parser.add_argument("--device", default=None)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with ht.open_sequence(root / "data" / "demo.npz") as sequence:
        make_video(options.out / "sample.webp", sequence, sequence.camera, "right", options.device)
    for name, recipe in SYNTHESISED.items():
        camera = CAMERAS["creative"]
        frames = synthesised_frames(recipe, camera, options.device)
        make_video(options.out / f"{name}.webp", frames, camera, recipe.side, options.device)


def synthesised_frames(
    recipe: Synthesised, camera: ht.Camera, device: str | None
) -> Iterator[ht.DepthFrame]:
    """The frames of a recipe."""
    model = ht.HandModel.load()
    shape = model.sample_shape(np.random.default_rng(recipe.subject))
    motion = Motion.load(recipe.motion)
    motion = motion.take(recipe.frames.start, recipe.frames.stop)
    hand = model.shaped(shape, side=recipe.side)
    noise = noise_preset(recipe.noise)
    return synthesize_sequence(motion, hand, camera, noise, seed=0, device=device)


def make_video(
    path: Path, frames: Iterable[ht.DepthFrame], camera: ht.Camera, side: str, device: str | None
) -> None:
    """Track frames and write what was found."""
    tracker = ht.HandTracker(camera, side=side, device=device)
    tracked = [(frame, tracker.track(frame.depth)) for frame in frames]
    sure = sum(hand.state.sure for _, hand in tracked)
    # Drawn with the size that was found in the end.
    style = PictureStyle(panel=PANEL, zoom=0.3)
    overlay = OverlayPainter(tracker.hand, camera, style=style)
    beside = SidePainter(tracker.hand, camera, style=SideStyle(panel=PANEL, span=0.3))
    with VideoWriter(path, frames_per_second=RATE, quality=QUALITY) as video:
        for frame, hand in tracked[::EVERY]:
            pose = None if hand.state is TrackState.NO_HAND else hand.pose
            video.write(np.hstack([
                overlay.paint_result(frame.depth, hand, index=frame.index),
                beside.paint(frame.depth, pose),
            ]))  # fmt: skip
    print(f"{path}: {sure} of {len(tracked)} frames tracked, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
