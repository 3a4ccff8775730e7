"""Objects held in the hand: docs/pictures/grasps.png.

Usage: python docs/pictures/make_grasps.py     (some minutes; needs the extra `physics`)
"""

from pathlib import Path

import cv2
import numpy as np

from handtrack.evaluation.suites.grasp_trials import GraspBench
from handtrack.evaluation.suites.suite import SuiteSettings, load_cases
from handtrack.viewer.grasp_view import GraspPainter
from handtrack.viewer.pictures import contact_sheet

OBJECTS = ("apple", "cube_70", "banana", "cup", "goblet", "bottle", "bunny", "pear")
SIZE = (1600, 600)


def main() -> None:
    """Hold one grasp of each object, draw them all."""
    bench = GraspBench(SuiteSettings(), load_cases("grasp"))
    pictures = []
    for name in OBJECTS:
        for number in range(3):
            trial = bench.trial(bench.attempt(name, number), "full")
            if trial.failure is None:
                break
        run, plan = trial.run, trial.attempt.plan
        if run is None or plan is None:
            raise SystemExit(f"no grasp of {name} holds")
        held = np.flatnonzero(run.holding)[-1]
        painter = GraspPainter(bench.hand, [bench.thing(name)])
        picture = painter.paint(run.hand_poses[held], [run.object_poses[held]])
        cv2.putText(
            picture, f"{name}, {plan.grip}", (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40),
            1, cv2.LINE_AA,
        )  # fmt: skip
        pictures.append(picture)
    sheet = cv2.resize(contact_sheet(pictures, 4), SIZE, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(Path(__file__).with_name("grasps.png")), sheet)


if __name__ == "__main__":
    main()
