"""The suite `grasp`: its cases, its controllers, how trials make a case."""

from __future__ import annotations

import json

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.report import bench_document, bench_rows
from handtrack.evaluation.suites.grasp_trials import Attempt, Trial, case_of
from handtrack.evaluation.suites.suite import CONTROLLERS, SuiteSettings, load_cases, run_suite
from handtrack.grasp.controller import VARIANTS
from handtrack.grasp.objective import ObjectiveConfig
from handtrack.grasp.taxonomy import GRIPS
from handtrack.objects.library import DATABASE_OBJECTS, TEST_OBJECTS


def test_the_cases_name_known_objects_grips_controllers_and_weights() -> None:
    data = load_cases("grasp")
    assert len(data["objects"]) >= 15
    named = [
        *data["objects"], *data["ablation"]["objects"], *data["controllers"]["objects"],
        *data["hands"]["objects"], data["grips"]["object"], data["stacking"]["object"],
        *(change["object"] for change in data["robustness"]["changes"]),
        *(change.get("instead", change["object"]) for change in data["robustness"]["changes"]),
    ]  # fmt: skip
    assert set(named) <= set(TEST_OBJECTS)
    assert not set(named) & set(DATABASE_OBJECTS)
    for size in (50, 70, 90, 110):
        assert f"cube_{size}" in data["objects"]
    for name in ("ablation", "controllers"):
        assert len(data[name]["objects"]) * data[name]["trials"] >= 50
    assert set(data["grips"]["names"]) <= set(GRIPS)
    assert set(data["trackers"]) <= set(VARIANTS) == set(CONTROLLERS)
    for switch in data["ablation"]["switches"]:
        ObjectiveConfig(**switch["objective"])


def test_another_tracker_than_a_controller_is_refused() -> None:
    with pytest.raises(InputError, match="pollard-zordan"):
        run_suite("grasp", SuiteSettings(trackers=("hybrid",), device="cpu"))


def test_sections_are_known_and_only_this_suite_has_them() -> None:
    with pytest.raises(InputError, match="stacking"):
        run_suite("grasp", SuiteSettings(sections=("juggling",), device="cpu"))
    with pytest.raises(InputError, match="no sections"):
        run_suite("recovery", SuiteSettings(sections=("stacking",), device="cpu"))


def test_trials_without_a_grasp_count_as_failures() -> None:
    lost = Trial(
        attempt=Attempt(key=None, name="egg", plan=None, reason="too heavy", seconds=0.2), run=None
    )
    case = case_of("egg", "full", [lost, lost])
    assert case["success_rate"] == 0.0 and case["trials"] == 2
    assert case["failures"] == ["egg: too heavy", "egg: too heavy"]
    assert case["synthesis_ms"]["median"] == pytest.approx(200.0)
    headers, rows = bench_rows([case])
    assert "0.0%" in rows[0] and "success" in headers
    json.dumps(bench_document("grasp", "cpu", [case]), allow_nan=False)


@pytest.mark.slow
def test_a_quick_run_reports_success_depth_and_speed() -> None:
    result = run_suite("grasp", SuiteSettings(device="cpu", quick=True))
    cases = {case["case"]: case for case in result.cases}
    assert set(cases) == {"all", *load_cases("grasp")["quick"]["objects"]}
    case = cases["all"]
    assert case["tracker"] == "full" and 0.0 <= case["success_rate"] <= 1.0
    assert case["penetration_mm"]["max"] < 10.0 and case["realtime_factor"] > 0.0
    assert np.isfinite(case["synthesis_ms"]["median"])
    bench_document("grasp", "cpu", result.cases)
    assert {target.value for target in result.targets} == {
        "success_rate", "realtime_factor", "synthesis_ms.median", "penetration_mm.max",
        "forces_ms.median",
    }  # fmt: skip
