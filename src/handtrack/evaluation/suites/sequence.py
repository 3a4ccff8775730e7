"""Suite `sequence`: any recorded sequence, with truth or without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handtrack.camera.frame import DepthFrame
from handtrack.errors import InputError
from handtrack.evaluation.runner import bench_case, run_tracker
from handtrack.evaluation.suites.suite import Overlay, SuiteResult, SuiteSettings, chosen
from handtrack.hand.model import HandModel
from handtrack.tracking.tracker import HandTracker


class _Part(Sequence[DepthFrame]):
    """Some of the frames of a recording, each read when it is asked for."""

    def __init__(self, frames: Sequence[DepthFrame], first: int, count: int) -> None:
        self._frames, self._first, self._count = frames, first, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, place: Any) -> Any:
        if not 0 <= place < self._count:
            raise IndexError(f"frame {place} of {self._count}")
        return self._frames[self._first + place]


def sequence_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/sequence.toml`."""
    data = chosen(settings, cases)
    recorded = settings.sequence
    if recorded is None:
        raise InputError("the suite sequence needs a recorded sequence: --sequence PATH")
    first = min(recorded.starts, default=0)
    count = min(len(recorded.frames) - first, int(data.get("frames", len(recorded.frames))))
    frames = _Part(recorded.frames, first, count)
    starts = {
        place - first: pose for place, pose in recorded.starts.items() if place < first + count
    }
    model = HandModel.load()
    found, errors, overlays = [], {}, []
    for name in data["trackers"]:
        tracker = HandTracker(
            frames[0].camera, side=recorded.side, shape=recorded.shape, device=settings.device,
            tracker=name, seed=settings.seed, model=model,
        )  # fmt: skip
        if not (starts or tracker.automatic):
            raise InputError(
                f"{recorded.name} has no labels that tell the first pose, which {name} needs: give "
                "it with --start POSE.json (28 numbers) or --start results.npz"
            )
        run = run_tracker(tracker, frames, starts, progress=settings.progress, text=name)
        found.append(bench_case(run, case=recorded.name, tracker=name, side=recorded.side))
        if run.labelled.any():
            errors[name] = run.errors_mm
        overlays += [
            Overlay(
                name=f"{recorded.name}-{name}-{frame.index:05d}", depth=frame.depth,
                camera=frame.camera, hand=tracker.hand, pose=run.poses[place],
                text=f"{name}, frame {frame.index}",
            )
            for place in sorted({count // 4, count // 2, 3 * count // 4})
            for frame in (frames[place],)
        ]  # fmt: skip
    return SuiteResult(
        suite="sequence",
        cases=found,
        errors_mm=errors,
        overlays=overlays,
        notes=list(recorded.notes),
    )
