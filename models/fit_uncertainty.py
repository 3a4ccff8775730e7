"""Fit the constants of `handtrack.fitting.uncertainty` on motion that no benchmark replays.

    python models/fit_uncertainty.py                      # about 5 min on two cores

Eight subjects (seeds 200 to 207) wear 70 frames each of `leap_hand_motion`, at its own distance and
0.12 and 0.25 m farther away, under three kinds of sensor noise, each with its own and with the mean
shape, followed by the hybrid tracker. OUTLINE, CORRELATION_LENGTH and PROPORTIONS are those that
bring 65 % of the errors within one sigma and 95 % within two: the least sum of both quantile losses
of log(error / sigma).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from handtrack.evaluation.metrics import calibration
from handtrack.evaluation.visibility import visible_keypoints
from handtrack.fitting import uncertainty
from handtrack.hand.model import HandModel
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.sequence import CAMERAS, synthesize_sequence
from handtrack.tracking.result import HandResult
from handtrack.tracking.tracker import HandTracker

Float = NDArray[np.float64]

SUBJECTS = range(200, 208)
FRAMES = 70
RATE_STRIDE = 4
"""Of 110 Hz."""
STRIDES = (1, 2)
DISTANCES = (0.0, 0.12, 0.25)
_TOF = ("time_of_flight",) * 3
NOISES = (*_TOF, "structured_light", *_TOF, "coded_light")
NOISE_SEED = 5
ONE, TWO = 0.65, 0.95
"""Shares wanted within one and two sigma, between those of one and of three dimensions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One tracked frame."""

    result: HandResult
    error: Float
    visible: NDArray[np.bool_]
    group: tuple[int, bool, int]


def main() -> None:
    """Track, fit, print."""
    model, motion = HandModel.load(), Motion.load("leap_hand_motion").take(0, None, RATE_STRIDE)
    samples: list[Sample] = []
    for place, seed in enumerate(SUBJECTS):
        first = place * (len(motion) // len(SUBJECTS))
        part = motion.take(first, first + FRAMES)
        poses = part.poses.copy()
        poses[:, 2] += DISTANCES[place % len(DISTANCES)]
        samples += track(replace(part, poses=poses), seed, NOISES[place], model)
        print(f"subject {seed}: {len(samples)} frames")
    errors = np.stack([sample.error for sample in samples])
    weights = group_weights(samples)

    def loss(logs: Float) -> float:
        off = np.log(np.maximum(errors, 1e-5) / deviations(samples, logs))
        return float((weights * (quantile(off, ONE) + quantile(off - np.log(2), TWO))).sum())

    start = np.log([uncertainty.OUTLINE, uncertainty.CORRELATION_LENGTH, uncertainty.PROPORTIONS])
    found = minimize(loss, start, method="Nelder-Mead", options={"maxfev": 90, "xatol": 0.01})
    print(f"loss {found.fun:.4f}: OUTLINE {np.exp(found.x[0]):.4f} m, CORRELATION_LENGTH "
          f"{np.exp(found.x[1]):.4f} m, PROPORTIONS {np.exp(found.x[2]):.4f}")  # fmt: skip
    sigma, seen = deviations(samples, found.x), np.stack([s.visible for s in samples])
    for known in (True, False):
        chosen = np.array([sample.group[1] == known for sample in samples])
        table = calibration(1e3 * errors[chosen], 1e3 * sigma[chosen], seen[chosen])
        print("own shape" if known else "mean shape", table)


def track(motion: Motion, seed: int, noise: str, model: HandModel) -> list[Sample]:
    """Track one subject with its own and with the mean shape, at two frame rates."""
    shape = model.sample_shape(np.random.default_rng(seed))
    hand, camera = model.shaped(shape), CAMERAS["creative"]
    frames = list(
        synthesize_sequence(motion, hand, camera, noise_preset(noise), seed=NOISE_SEED)
    )  # fmt: skip
    visible = visible_keypoints(hand, camera, motion.to_poses())
    found = []
    for known in (True, False):
        tracker = HandTracker(camera, shape=shape if known else None, tracker="hybrid", model=model)
        for stride in STRIDES:
            take = 0
            for place in range(0, len(frames), stride):
                truth = frames[place].truth
                assert truth is not None and truth.keypoints is not None
                now = int(np.searchsorted(motion.segment_starts, place, side="right"))
                if now != take:
                    tracker.reset(truth.pose)
                take = now
                result = tracker.track(frames[place].depth)
                if result.information is not None:
                    error = np.linalg.norm(result.keypoints - truth.keypoints, axis=1)
                    found.append(Sample(
                        result=result, error=error.astype(np.float64), visible=visible[place],
                        group=(seed, known, stride),
                    ))  # fmt: skip
    return found


def deviations(samples: list[Sample], logs: Float) -> Float:
    """Deviations [m], shape (n, 21), with the logarithms of the three constants."""
    constants = np.exp(logs).tolist()
    uncertainty.OUTLINE, uncertainty.CORRELATION_LENGTH, uncertainty.PROPORTIONS = constants
    return np.stack([
        uncertainty.keypoint_deviation(s.result.hand, s.result.pose, s.result.information)
        for s in samples
        if s.result.information is not None
    ])  # fmt: skip


def group_weights(samples: list[Sample]) -> Float:
    """Weights, shape (n, 21), by which a group counts as the root of its size."""
    groups = [[(*s.group, bool(v)) for v in s.visible] for s in samples]
    sizes: dict[tuple[int, bool, int, bool], int] = {}
    for row in groups:
        for group in row:
            sizes[group] = sizes.get(group, 0) + 1
    weights = np.array([[sizes[group] ** -0.5 for group in row] for row in groups])
    return weights / weights.sum()


def quantile(off: Float, share: float) -> Float:
    """Loss that is least when so large a share is negative."""
    return np.where(off > 0, share * off, (share - 1) * off)


if __name__ == "__main__":
    main()
