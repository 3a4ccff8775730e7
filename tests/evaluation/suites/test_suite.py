"""Running suites by name: their shape, first poses, names with dashes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from handtrack.errors import InputError
from handtrack.evaluation.suites import suite
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, run_suite


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, SuiteSettings]]:
    """Module and settings of every suite that is run, none of which does anything."""
    seen = []

    def load(name: str) -> SimpleNamespace:
        module = name.rpartition(".")[2]

        def run(settings: SuiteSettings, cases: object) -> SuiteResult:
            seen.append((module, settings))
            return SuiteResult(suite=module, cases=[])

        return SimpleNamespace(**{f"{module}_suite": run})

    monkeypatch.setattr(suite, "import_module", load)
    return seen


def test_every_suite_has_a_shape_of_its_own(ran: list[tuple[str, SuiteSettings]]) -> None:
    for name in ("tracking", "single-frame", "recovery", "scenes", "real"):
        run_suite(name, SuiteSettings())
    assert [(module, settings.shape) for module, settings in ran] == [
        ("tracking", "given"), ("single_frame", "mean"), ("recovery", "mean"),
        ("scenes", "mean"), ("real", "mean"),
    ]  # fmt: skip
    run_suite("single-frame", SuiteSettings(shape="given"))
    assert ran[-1][1].shape == "given"


def test_only_tracking_lets_first_poses_be_found(ran: list[tuple[str, SuiteSettings]]) -> None:
    found = SuiteSettings(first_pose="found")
    run_suite("tracking", found)
    assert ran[-1][1] == replace(found, shape="given")
    with pytest.raises(InputError, match="tracking does"):
        run_suite("recovery", found)
