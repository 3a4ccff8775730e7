"""Depth sequences from motion: a subject's hand and forearm, seen by a camera with sensor noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.camera.sequence import ASSUMED_RATE
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.hand.side import mirror_pose
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import NONE, SensorNoise
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import quat_to_matrix

FOREARM_LENGTH = 0.25
"""Distance from wrist to elbow [m] where the elbow was not recorded."""

CAMERAS: dict[str, Camera] = {
    "creative": Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0),
    "realsense": Camera(width=640, height=480, fx=475.1, fy=475.1, cx=315.9, cy=245.3),
    "primesense": Camera(width=640, height=480, fx=588.03, fy=587.07, cx=320.0, cy=240.0),
}
"""Cameras of the MSRA (Creative), SR305 (RealSense) and NYU (PrimeSense) recordings."""

_BATCH = 16


def synthesize_sequence(
    motion: Motion,
    hand: ShapedHand,
    camera: Camera,
    noise: SensorNoise = NONE,
    *,
    stride: int = 1,
    seed: int = 0,
    forearm: bool = True,
    device: str | None = None,
) -> Iterator[DepthFrame]:
    """Render a motion, worn by a subject, frame by frame.

    A frame's noise depends on the seed and on the frame's number in the motion alone: every
    second frame of a sequence is the sequence of every second frame.

    Args:
        motion: Motion of a right hand; a left hand makes the mirror image of it.
        hand: The subject's hand.
        camera: Camera that sees it; the motion is in its frame.
        noise: Noise of the sensor.
        stride: Keep every n-th frame.
        seed: Seed of the noise.
        forearm: Draw a forearm towards the recorded elbow, straight where there is none; False
            draws the model's own stub.
        device: "cpu", "cuda:N" or None for the best there is.

    Yields:
        Frames with keypoints, pose and side as truth, stamped by the motion's rate.

    Raises:
        InputError: The stride is not positive.
    """
    if stride < 1:
        raise InputError(f"stride is {stride}: expected 1 or more")
    return _frames(motion, hand, camera, noise, stride, seed, forearm, device)


def _frames(
    motion: Motion,
    hand: ShapedHand,
    camera: Camera,
    noise: SensorNoise,
    stride: int,
    seed: int,
    forearm: bool,
    device: str | None,
) -> Iterator[DepthFrame]:
    renderer = DepthRenderer(hand, camera, device=device, batch=_BATCH)
    rate = motion.frames_per_second or ASSUMED_RATE
    chosen = np.arange(0, len(motion), stride)
    poses, elbows = worn_by(motion, hand)
    points = keypoints(hand, poses).astype(np.float32)
    for first in range(0, len(chosen), _BATCH):
        part = chosen[first : first + _BATCH]
        images = renderer.render(poses[part], elbows=elbows[part] if forearm else None)
        for place, (source, image) in enumerate(zip(part.tolist(), images, strict=True)):
            rng = np.random.default_rng([seed, source])
            yield DepthFrame(
                depth=noise.apply(image, camera, rng),
                camera=camera,
                time=source / rate,
                index=first + place,
                name=f"{motion.name}[{source}]",
                truth=FrameTruth(keypoints=points[source], pose=poses[source], side=hand.side),
            )


def worn_by(motion: Motion, hand: ShapedHand) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses, shape (n, 28), and elbows [m], shape (n, 3), of a motion for one hand.

    A left hand gets the mirrored motion. Where no elbow was recorded the forearm goes on straight.
    """
    poses = motion.to_poses()
    elbows = None if motion.elbows is None else motion.elbows.astype(np.float64)
    if hand.side == "left":
        poses = mirror_pose(poses)
        elbows = None if elbows is None else elbows * [-1.0, 1.0, 1.0]
    if elbows is None:
        elbows = poses[:, :3] - FOREARM_LENGTH * quat_to_matrix(poses[:, 3:7])[..., 0]
    return poses, elbows


def frames_out_of_view(motion: Motion, hand: ShapedHand, camera: Camera) -> NDArray[np.bool_]:
    """Frames with a keypoint outside of the image or behind the camera, shape (n,)."""
    pixels = camera.project(keypoints(hand, worn_by(motion, hand)[0]))
    size = np.array([camera.width, camera.height])
    # NaN, a point behind the camera, is not inside.
    inside = (pixels > -0.5) & (pixels < size - 0.5)
    return np.logical_not(np.all(inside, axis=(1, 2)))
