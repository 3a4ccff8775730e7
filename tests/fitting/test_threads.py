"""Rows split over host threads: the same numbers as on one, frame after frame, on the CPU.

Warp's CPU graphs and tiles have global state that two threads can upset, even to a crash of the
interpreter, so the check runs in an interpreter of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import faulthandler
faulthandler.enable()
import numpy as np
from oracles.scenes import SMALL_CAMERA, hand_centre, seen_poses, shaped_hand
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import apply_increment

rng = np.random.default_rng(1)
hand = shaped_hand()
truth = seen_poses(hand, rng, 3, turn=0.3, bend=0.2)
depth = DepthRenderer(hand, SMALL_CAMERA, device="cpu", batch=1).render(truth)
starts = apply_increment(np.repeat(truth, 2, 0), 0.03 * rng.uniform(-1, 1, (6, 27)))
config = FitConfig(crop_cells=32, levenberg=True, collision_weight=1.0)

def results(threads, graph, frames):
    fitter = Fitter(
        [hand] * 3, SMALL_CAMERA, config=config, nhyp=2, device="cpu", graph=graph, threads=threads
    )
    fitter.load_depth(depth)
    fitter.place(hand_centre(hand, truth))
    for frame in range(frames):
        fitter.set_poses(starts + 0.001 * (frame % 5))
        fitter.run()
        yield fitter.poses, fitter.errors

for graph in (True, False):
    one = list(results(1, graph, 5))
    for threads in (2, 3, 64):
        for frame, (poses, errors) in enumerate(results(threads, graph, 30)):
            expected_poses, expected_errors = one[frame % 5]
            assert np.array_equal(poses, expected_poses), (graph, threads, frame)
            assert np.array_equal(errors, expected_errors), (graph, threads, frame)
print("equal")
"""


def test_several_threads_equal_one() -> None:
    root = Path(__file__).resolve().parents[1]
    paths = [str(root), *filter(None, sys.path)]
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )
    assert result.returncode == 0, f"exit {result.returncode}\n{result.stderr[-3000:]}"
    assert result.stdout.rstrip().endswith("equal")
