"""Learn `pose_prior.npz` from recorded motion retargeted onto our skeleton.

    python models/build_pose_prior.py --recordings DIR

DIR holds nyu_test_joints36.npz; the Leap motion is read from data/motions/. The motion that the
tracking benchmark replays (data/motions/recorded_hand_motion.npz) is left out on purpose.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import ANGLES
from handtrack.priors.gaussian import GaussianPrior
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.retarget import retarget_keypoints

Float = NDArray[np.float64]

OUT = Path(__file__).resolve().parent / "pose_prior.npz"
SEED = 20170817
PER_SOURCE = 2400
"""Frames drawn from each source, so that both weigh the same; as many from each of its takes."""
EXPLAINED = 0.95
"""Share of the variance that the axes must explain."""

NYU_HANDS = ((0, 2440), (2440, 3136), (3136, 8252))
"""Frames over which the annotated hand keeps its size; takes of the source."""
NYU_STRIDE = 8
"""Every n-th annotated frame; neighbours tell nothing new."""
NYU_HELD_OUT = ((0, 51), (1689, 1790))
"""Frames of the two real images that accuracy is measured on, and their neighbours."""
NYU_FINGERS = (24, 18, 12, 6, 0)
"""First of the six points, tip first, of thumb, index, middle, ring, little."""


def main() -> None:
    """Learn, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--recordings", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    sources = {"leap": leap_angles(), "nyu": nyu_angles(options.recordings)}
    rng = np.random.default_rng(SEED)
    drawn = {name: draw(takes, PER_SOURCE, rng) for name, takes in sources.items()}
    prior = GaussianPrior.learn(np.concatenate(list(drawn.values())), explained=EXPLAINED)
    prior.save(
        options.out,
        source="leapmotion/leapjs-playback recordings (Apache-2.0) and the test annotations of the "
        "NYU Hand Pose data set (Tompson et al. 2014), both retargeted; statistics only",
        licence="Apache-2.0",
    )
    describe(prior, drawn)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.1f} kB")


def leap_angles() -> list[Float]:
    """Joint angles of each Leap take, shape (n, 21)."""
    motion = Motion.load("leap_hand_motion")
    return [motion.poses[take, 6:].astype(np.float64) for take in motion.segments]


def nyu_angles(recordings: Path) -> list[Float]:
    """Joint angles of each annotated NYU hand, shape (n, 21)."""
    with np.load(recordings / "nyu_test_joints36.npz", allow_pickle=False) as data:
        joints = data["joints"].astype(np.float64)
    use = np.zeros(len(joints), bool)
    use[::NYU_STRIDE] = True
    for first, last in NYU_HELD_OUT:
        use[first:last] = False
    hand, angles = HandModel.load().shaped(), []
    for first, last in NYU_HANDS:
        found = retarget_keypoints(hand, nyu_keypoints(joints[first:last][use[first:last]]))
        residual = 1e3 * found.residual
        print(
            f"nyu {first}:{last}: {len(residual)} frames, residual mean {residual.mean():.2f} mm, "
            f"95 % {np.percentile(residual, 95):.2f} mm"
        )
        angles.append(found.poses[:, 7:])
    return angles


def nyu_keypoints(joints: Float) -> Float:
    """Our keypoints [m], shape (n, 21, 3), guessed from the 36 points, shape (n, 36, 3).

    Two points of one phalanx keep their distance; a joint lies between the points of neighbouring
    phalanges. Lengths are fitted by the retargeting, so the guess need only be consistent.
    """
    keypoints = np.empty((len(joints), 21, 3))
    keypoints[:, 0] = joints[:, 30:32].mean(1)
    for finger, tip in enumerate(NYU_FINGERS):
        keypoints[:, 1 + 4 * finger] = joints[:, tip + 5]
        keypoints[:, 2 + 4 * finger] = joints[:, tip + 3 : tip + 5].mean(1)
        keypoints[:, 3 + 4 * finger] = joints[:, tip + 1 : tip + 3].mean(1)
        keypoints[:, 4 + 4 * finger] = joints[:, tip]
    return keypoints


def draw(takes: list[Float], count: int, rng: np.random.Generator) -> Float:
    """As many frames of each take, `count` in all, shape (count, 21)."""
    each = np.diff(np.linspace(0, count, len(takes) + 1).round().astype(int))
    return np.concatenate([
        take[rng.choice(len(take), size, replace=size > len(take))]
        for take, size in zip(takes, each, strict=True)
    ])  # fmt: skip


def describe(prior: GaussianPrior, drawn: dict[str, Float]) -> None:
    """Print what the axes explain, in total and of each source."""
    everything = np.concatenate(list(drawn.values()))
    shares = np.cumsum(prior.variances) / np.trace(np.cov(everything.T))
    print("explained variance, axis by axis:", " ".join(f"{share:.3f}" for share in shares))
    for name, angles in {**drawn, "all": everything}.items():
        off = angles - prior.mean
        left = off - (off @ prior.axes) @ prior.axes.T
        explained = 1 - (left**2).sum() / (off**2).sum()
        degrees = np.degrees(np.sqrt((left**2).mean()))
        print(
            f"{name}: {len(angles)} frames, {explained:.3f} explained, {degrees:.1f} degrees left"
        )
    deviation = np.degrees(np.sqrt(np.diag(prior.covariance)))
    for name, mean, spread in zip(ANGLES, np.degrees(prior.mean), deviation, strict=True):
        print(f"  {name:22s} {mean:6.1f} +- {spread:4.1f} degrees")


if __name__ == "__main__":
    main()
