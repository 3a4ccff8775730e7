"""Retarget recorded hand motion onto our skeleton; write data/motions/*.npz, print what is left.

Usage: python data/make_motions.py --recordings DIR [--out data/motions]

DIR holds recorded_hand_motion.npz and leap_hand_motion.npz (data/README.md says what they are).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.retarget import Retargeted, retarget_keypoints

Float = NDArray[np.float64]

LEAP_DISTANCE = 0.2
"""How far behind the Leap device the camera stands [m]; hands come as near as 0.1 m to the device,
nearer than depth cameras see."""

R_CAMERA_LEAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""A camera that looks up from the desk as the device does: z is Leap's y (up), x is Leap's x."""


def main() -> None:
    """Write all motions."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--recordings", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "motions")
    options = parser.parse_args()
    hand = HandModel.load().shaped()
    for make in (recorded_motion, leap_motion):
        motion = make(hand, options.recordings)
        path = motion.save(options.out / f"{motion.name}.npz")
        print(f"{path}: {len(motion)} frames, {path.stat().st_size / 1e3:.0f} kB")


def recorded_motion(hand: ShapedHand, recordings: Path) -> Motion:
    """Motion of recorded_hand_motion.npz, with elbows."""
    with np.load(recordings / "recorded_hand_motion.npz", allow_pickle=False) as data:
        recorded = data["keypoints"].astype(np.float64)
        # The proximal end of the bone that the recording calls wrist_forearm is the elbow.
        elbows = data["bone_origins"][:, 0]
        starts = data["segment_starts"]
    found = retarget_keypoints(hand, recorded)
    report("recorded_hand_motion", found)
    return Motion.from_poses(
        found.poses,
        elbows=elbows,
        segment_starts=starts[starts < len(recorded)],
        name="recorded_hand_motion",
        source="IntelRealSense/hand_tracking_samples, assets/animbank.pose, retargeted",
        licence="Apache-2.0",
    )


def leap_motion(hand: ShapedHand, recordings: Path) -> Motion:
    """Motion of all takes of leap_hand_motion.npz, one after the other."""
    poses, starts, steps = [], [], []
    with np.load(recordings / "leap_hand_motion.npz", allow_pickle=False) as data:
        names = sorted(key.removesuffix("__joints") for key in data if key.endswith("__joints"))
        takes = [(data[f"{name}__joints"], data[f"{name}__time_s"]) for name in names]
    for name, (joints, times) in zip(names, takes, strict=True):
        seen = joints.astype(np.float64) @ R_CAMERA_LEAP.T + [0.0, 0.0, LEAP_DISTANCE]
        recorded = np.full((len(seen), 21, 3), np.nan)
        recorded[:, 1:] = seen.reshape(len(seen), 20, 3)
        recorded[:, 0] = guess_wrists(hand, recorded)
        found = retarget_keypoints(hand, recorded)
        report(f"leap {name}", found)
        starts.append(sum(map(len, poses)))
        poses.append(found.poses)
        steps.append(np.diff(times))
    return Motion.from_poses(
        np.concatenate(poses),
        segment_starts=starts,
        frames_per_second=round(1 / float(np.median(np.concatenate(steps)))),
        name="leap_hand_motion",
        source=f"leapmotion/leapjs-playback, takes {', '.join(names)}, retargeted",
        licence="Apache-2.0",
    )


def guess_wrists(hand: ShapedHand, recorded: Float) -> Float:
    """Wrists [m], shape (n, 3), where our hand has them once it is laid on thumb base and knuckles.

    Args:
        hand: Our hand.
        recorded: Keypoints [m], shape (n, 21, 3), wrist unknown.
    """
    rest = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], hand.rest_angles])
    own = keypoints(hand, rest)
    known = [1, 5, 9, 13, 17]
    goal = recorded[:, known]
    a = own[known] - own[known].mean(0)
    b = goal - goal.mean(1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("npi,pj->nij", b, a))
    flip = np.ones((len(goal), 3))
    flip[:, 2] = np.linalg.det(u @ vt)
    rotation = (u * flip[:, None]) @ vt
    scale = np.linalg.norm(b, axis=(1, 2)) / np.linalg.norm(a)
    offset = own[0] - own[known].mean(0)
    return goal.mean(1) + scale[:, None] * (rotation @ offset)


def report(name: str, found: Retargeted) -> None:
    """Print how far the keypoints lie from where they were recorded."""
    residual = 1e3 * found.residual
    print(
        f"{name}: {len(residual)} frames, residual mean {np.nanmean(residual):.2f} mm, "
        f"95 % {np.nanpercentile(residual, 95):.2f} mm, worst {np.nanmax(residual):.2f} mm"
    )


if __name__ == "__main__":
    main()
