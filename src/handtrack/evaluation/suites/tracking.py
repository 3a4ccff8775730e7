"""Suite `tracking`: recorded motion with forearm and sensor noise, by subject and frame rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handtrack.evaluation.runner import Run, bench_case, join_runs
from handtrack.evaluation.suites.subjects import case_facts, render_subject, track_subject
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
        for tracker in data["trackers"]:
            for stride in data["strides"]:
                runs[tracker, stride, seed] = track_subject(
                    subject, stride, settings, model, tracker=tracker,
                    text=f"subject {seed}, stride {stride}, {tracker}",
                )  # fmt: skip
        del subject

    found, errors = [], {}
    for tracker in data["trackers"]:
        for number, seed in enumerate(data["subjects"]):
            for stride in data["strides"]:
                facts = case_facts(settings, [seed], stride)
                case = f"subject-{number}/stride-{stride}"
                run = runs[tracker, stride, seed]
                found.append(bench_case(run, case=case, tracker=tracker, **facts))
        for stride in data["strides"]:
            facts = case_facts(settings, data["subjects"], stride)
            run = join_runs([runs[tracker, stride, seed] for seed in data["subjects"]])
            case = f"all/stride-{stride}"
            found.append(bench_case(run, case=case, tracker=tracker, **facts))
            errors[f"{tracker}, stride {stride}"] = run.errors_mm
    return SuiteResult(
        suite="tracking",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        errors_mm=errors,
        notes=[f"shape {settings.shape}; first pose of each take given; noise {data['noise']}"],
    )
