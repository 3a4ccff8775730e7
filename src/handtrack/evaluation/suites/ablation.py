"""Suite `ablation`: the tracker with every switch changed against its default, one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from handtrack.errors import InputError, MissingFileError
from handtrack.evaluation.runner import bench_case, join_runs
from handtrack.evaluation.suites.subjects import (
    SubjectFrames,
    case_facts,
    render_subject,
    track_subject,
)
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen
from handtrack.hand.model import HandModel
from handtrack.tracking.model_based import ModelBasedConfig
from handtrack.tracking.tracker import TRACKERS

FIT = "fit."
"""Prefix of the fields of `FitConfig` among the changes."""


def ablation_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/ablation.toml`."""
    data = chosen(settings, cases)
    model = HandModel.load()
    subjects = [render_subject(data, seed, settings, model) for seed in data["subjects"]]
    found, notes = [], []
    for tracker in data["trackers"]:
        default = TRACKERS[tracker]
        if not isinstance(default, ModelBasedConfig):
            raise InputError(f"{tracker} has none of the switches of the suite ablation")
        for name, config in variants(default, data["switches"]):
            try:
                found += _cases(name, config, tracker, subjects, data, settings, model)
            except MissingFileError as error:
                notes.append(f"{name} is left out: {error}")
    return SuiteResult(suite="ablation", cases=found, notes=notes)


def _cases(
    name: str,
    config: ModelBasedConfig,
    tracker: str,
    subjects: list[SubjectFrames],
    data: Mapping[str, Any],
    settings: SuiteSettings,
    model: HandModel,
) -> list[dict[str, Any]]:
    """One case per frame rate of one variant."""
    found = []
    for stride in data["strides"]:
        runs = [
            track_subject(
                subject, stride, settings, model, tracker=tracker, config=config,
                text=f"{name}, stride {stride}",
            )
            for subject in subjects
        ]  # fmt: skip
        run = join_runs(runs)
        facts = case_facts(settings, data["subjects"], stride, run)
        case = f"{name}/stride-{stride}"
        found.append(bench_case(run, case=case, tracker=tracker, **facts))
    return found


def variants(
    default: ModelBasedConfig, switches: list[Mapping[str, Any]]
) -> list[tuple[str, ModelBasedConfig]]:
    """The default, then one configuration for each switch, with its name.

    Args:
        default: The tracker's own settings.
        switches: Entries `name`, `off` and `on`, the latter two with changed fields.
    """
    found = [("default", default)]
    for switch in switches:
        off, on = (changed(default, switch[state]) for state in ("off", "on"))
        name = switch["name"]
        found.append((f"with {name}", on) if off == default else (f"without {name}", off))
    return found


def changed(config: ModelBasedConfig, changes: Mapping[str, Any]) -> ModelBasedConfig:
    """A configuration with some fields changed; those of the fit are named "fit.FIELD".

    A value that is text names another field, whose value is taken.

    Raises:
        InputError: There is no such field, or its value is out of range.
    """
    known = {field.name for field in fields(config)} | {
        FIT + field.name for field in fields(config.fit)
    }
    for key in changes:
        if key not in known:
            raise InputError(
                f"an ablation changes {key!r}: expected one of {', '.join(sorted(known))}"
            )
    values = {key: _value(config, value) for key, value in changes.items()}
    inner = {key.removeprefix(FIT): value for key, value in values.items() if key.startswith(FIT)}
    outer = {key: value for key, value in values.items() if not key.startswith(FIT)}
    return replace(config, fit=replace(config.fit, **inner), **outer)


def _value(config: ModelBasedConfig, value: Any) -> Any:
    """A number, or the field that it names."""
    if not isinstance(value, str):
        return value
    inner = value.startswith(FIT)
    return getattr(config.fit if inner else config, value.removeprefix(FIT))
