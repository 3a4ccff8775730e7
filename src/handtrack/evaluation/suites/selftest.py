"""Suite `selftest`: strong self-occlusion without noise, the tracker's own model, first pose given.

The test of Hamer, PhD thesis, ETH Zurich, section 4.4.1: mean distance of phalanx end points.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtrack.camera.camera import Camera
from handtrack.evaluation.metrics import phalanx_errors, phalanx_summary
from handtrack.evaluation.runner import bench_case, run_tracker
from handtrack.evaluation.suites.fist import fist_motion
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.hand.model import HandModel
from handtrack.synthesis.noise import noise_preset
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.tracker import HandTracker


def selftest_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/selftest.toml`."""
    data = chosen(settings, cases)
    camera = Camera.from_dict(data["camera"])
    model = HandModel.load()
    hand = model.shaped()
    motion = fist_motion(data, hand)
    if "frames" in data:
        motion = motion.take(stop=int(data["frames"]))
    # The model's own stub instead of a forearm: nothing but the tracker's own model is in view.
    frames = list(
        settings.progress(
            synthesize_sequence(
                motion, hand, camera, noise_preset(data["noise"]), seed=settings.seed,
                forearm=False, device=settings.device,
            ),
            len(motion),
            "rendering",
        )
    )  # fmt: skip
    starts = {0: motion.to_poses()[0]}
    found, errors = [], {}
    for name in data["trackers"]:
        tracker = HandTracker(
            camera, device=settings.device, tracker=name, seed=settings.seed, model=model
        )
        run = run_tracker(tracker, frames, starts, progress=settings.progress, text=name)
        summary = phalanx_summary(run.keypoints, run.truth)
        found.append(bench_case(run, case="selftest", tracker=name, phalanx_error_mm=summary))
        errors[name] = phalanx_errors(run.keypoints, run.truth)
    return SuiteResult(
        suite="selftest",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        notes=[
            "phalanx: mean distance of the two end points of a segment from their true places, "
            "over the 16 segments; there, 6.2 s per frame gave mean 1.04 and at most 2.77 mm"
        ],
    )
