"""Suite `sequence`: any recorded sequence, with truth or without."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtrack.errors import InputError
from handtrack.evaluation.runner import bench_case, run_tracker
from handtrack.evaluation.suites.suite import Overlay, SuiteResult, SuiteSettings, chosen
from handtrack.hand.model import HandModel
from handtrack.tracking.tracker import HandTracker


def sequence_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/sequence.toml`."""
    data = chosen(settings, cases)
    recorded = settings.sequence
    if recorded is None:
        raise InputError("the suite sequence needs a recorded sequence: --sequence PATH")
    frames = recorded.frames[: data.get("frames")]
    starts = {place: pose for place, pose in recorded.starts.items() if place < len(frames)}
    model = HandModel.load()
    found, errors, overlays = [], {}, []
    for name in data["trackers"]:
        tracker = HandTracker(
            frames[0].camera, side=recorded.side, shape=recorded.shape, device=settings.device,
            tracker=name, seed=settings.seed, model=model,
        )  # fmt: skip
        run = run_tracker(tracker, frames, starts, progress=settings.progress, text=name)
        found.append(bench_case(run, case=recorded.name, tracker=name, side=recorded.side))
        if run.labelled.any():
            errors[name] = run.errors_mm
        overlays += [
            Overlay(
                name=f"{recorded.name}-{name}-{place:05d}", depth=frames[place].depth,
                camera=frames[place].camera, hand=tracker.hand, pose=run.poses[place],
                text=f"{name}, frame {frames[place].index}",
            )
            for place in (len(frames) // 4, len(frames) // 2, 3 * len(frames) // 4)
        ]  # fmt: skip
    return SuiteResult(
        suite="sequence", cases=found, errors_mm=errors, overlays=overlays, notes=list(recorded.notes)
    )
