"""Learn `judge.npz` from scenes with hands and without, searched as the hybrid tracker searches.

    python models/build_judge.py

Every scene is searched by a tracker that does not know the person's size; the pose it comes to is
right within 20 mm (mean of the keypoints), wrong beyond 40 mm or where there is no hand, and left
out between. Each pose counts twice: as found, and after the size was adapted. Prints how right and
wrong poses of held-out scenes are told apart. About half an hour on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.forest.scenes import SceneMaker
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.synthesis.dataset import DatasetConfig, SyntheticDataset
from handtrack.synthesis.things import cup_mesh
from handtrack.tracking.hybrid import HybridConfig, TrackerHybrid
from handtrack.tracking.judge import JudgeModel, judge_features
from handtrack.tracking.likeness import HandLikeness

OUT = Path(__file__).resolve().parent / "judge.npz"
SEED = 3000
RIGHT, WRONG = 0.02, 0.04
FOLDS = 5
CUPS = ((0.03, 0.12), (0.035, 0.08), (0.041, 0.095), (0.045, 0.14), (0.05, 0.07))
"""Radius and height [m]."""

Float = NDArray[np.float64]


def main() -> None:
    """Search, learn, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=1500)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    features, errors, scenes = collect(options.scenes)
    features, errors, scenes = (
        part[np.isfinite(features).all(axis=1)] for part in (features, errors, scenes)
    )
    right = errors < RIGHT
    clear = right | ~(errors <= WRONG)
    features, right, scenes = features[clear], right[clear], scenes[clear]
    describe(features, right, scenes)
    JudgeModel.learn(features, right).save(
        options.out,
        source=f"{options.scenes} synthetic scenes of seed {SEED}, searched by the hybrid tracker: "
        f"{right.sum()} right and {(~right).sum()} wrong poses",
    )


def collect(count: int) -> tuple[Float, Float, NDArray[np.int64]]:
    """Features of the poses found, their mean keypoint errors [m], NaN without a hand, scenes."""
    config = DatasetConfig(subjects=40, poses=100, viewpoints=2, seed=SEED)
    dataset = SyntheticDataset(config, device="cpu")
    cups = [cup_mesh(radius=radius, height=height) for radius, height in CUPS]
    maker = SceneMaker(dataset, cups=cups)
    mean_hand = HandModel.load().shaped()
    tracker = TrackerHybrid(mean_hand, config.camera, config=HybridConfig(judged=False))
    likeness = HandLikeness(mean_hand, config.camera)
    features, errors, scenes = [], [], []
    for number in range(count):
        depth, middle = maker.scene(number)
        truth = None if middle is None else dataset.render([number]).keypoints[0]
        for found, hand in tracker.first_looks(depth):
            off = np.nan
            if truth is not None:
                off = float(np.linalg.norm(keypoints(hand, found.pose) - truth, axis=1).mean())
            likeness.resize(hand)
            features.append(
                judge_features(likeness, depth, found.pose, found.error, found.presence)
            )
            errors.append(off)
            scenes.append(number)
        if number % 100 == 99:
            print(f"{number + 1} of {count} scenes", flush=True)
    return np.array(features), np.array(errors), np.array(scenes)


def describe(features: Float, right: NDArray[np.bool_], scenes: NDArray[np.int64]) -> None:
    """How well poses of scenes that were not learnt from are told apart."""
    for placed in (True, False):
        odds = np.empty(len(features))
        for fold in range(FOLDS):
            out = scenes % FOLDS == fold
            learnt = JudgeModel.learn(features[~out], right[~out])
            odds[out] = learnt.log_odds(features[out], placed=placed)
        print("first sight" if placed else "while tracking")
        for chance in (0.3, 0.5, 0.7, 0.8, 0.9):
            taken = odds > np.log(chance / (1 - chance))
            print(
                f"  above {chance:.0%}: {taken[right].mean():6.1%} of {right.sum()} right,"
                f" {taken[~right].mean():6.1%} of {(~right).sum()} wrong poses"
            )


if __name__ == "__main__":
    main()
