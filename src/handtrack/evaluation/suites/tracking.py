"""Suite `tracking`: recorded motion with forearm and sensor noise, by subject and frame rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handtrack.evaluation.runner import Run, bench_case, join_runs
from handtrack.evaluation.suites.first_pose import found_starts
from handtrack.evaluation.suites.subjects import (
    case_facts,
    render_subject,
    subject_tracker,
    track_subject,
)
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.hand.model import HandModel


def tracking_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/tracking.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    runs: dict[tuple[str, int, int], Run] = {}
    for seed in data["subjects"]:
        # One subject's frames are held at a time: 460 MB for the whole motion.
        subject = render_subject(data, seed, settings, model)
        for stride in data["strides"]:
            starts = None
            if settings.first_pose == "found":
                frames, takes = subject.every(stride)
                finder = subject_tracker(subject, settings, model, tracker=data["finder"])
                starts = found_starts(finder, frames, sorted(takes))
            for tracker in data["trackers"]:
                runs[tracker, stride, seed] = track_subject(
                    subject, stride, settings, model, tracker=tracker, starts=starts,
                    text=f"subject {seed}, stride {stride}, {tracker}",
                )  # fmt: skip
        del subject

    found, errors = [], {}
    for tracker in data["trackers"]:
        for number, seed in enumerate(data["subjects"]):
            for stride in data["strides"]:
                run = runs[tracker, stride, seed]
                facts = case_facts(settings, [seed], stride, run)
                case = f"subject-{number}/stride-{stride}"
                found.append(bench_case(run, case=case, tracker=tracker, **facts))
        for stride in data["strides"]:
            run = join_runs([runs[tracker, stride, seed] for seed in data["subjects"]])
            facts = case_facts(settings, data["subjects"], stride, run)
            case = f"all/stride-{stride}"
            found.append(bench_case(run, case=case, tracker=tracker, **facts))
            errors[f"{tracker}, stride {stride}"] = run.errors_mm
    return SuiteResult(
        suite="tracking",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        notes=[
            f"shape {settings.shape}; noise {data['noise']}",
            *(_told(tracker, found, data) for tracker in data["trackers"]),
        ],
    )


def _told(tracker: str, cases: Sequence[Mapping[str, Any]], data: Mapping[str, Any]) -> str:
    """What a tracker was told of its poses."""
    case = next(case for case in reversed(cases) if case["tracker"] == tracker)
    if case["first_pose"] == "none":
        return f"{tracker}: no pose given, at the first frame or after a cut"
    source = {
        "truth": "the true pose given at the first frame of each take",
        "found": f"started with what {data['finder']} finds without memory at the first frame of "
        "each take, or at the next one where it finds the hand",
    }
    return f"{tracker}: {source[case['first_pose']]}"
