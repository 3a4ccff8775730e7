"""What the tests of several suites share: quick settings, and a tracker that knows the truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from handtrack.evaluation.report import bench_document
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings
from handtrack.tracking.tracker import TRACKERS
from oracles.automatic import AutomaticOracle


@pytest.fixture
def oracle(monkeypatch: pytest.MonkeyPatch) -> AutomaticOracle:
    """An automatic tracker, registered as `oracle` and in the place of `hybrid`."""
    made = AutomaticOracle()
    for name in ("oracle", "hybrid"):
        monkeypatch.setitem(TRACKERS, name, made)
    return made


@pytest.fixture
def quick() -> SuiteSettings:
    """The small part of a suite, tracked by the oracle."""
    return SuiteSettings(quick=True, device="cpu", trackers=("oracle",))


@pytest.fixture
def teach(monkeypatch: pytest.MonkeyPatch, oracle: AutomaticOracle) -> Callable[[Any, str], None]:
    """Lets the oracle look at what a function of a suite's module renders: frames, or their owner.

    Arguments: the module, and the function's name.
    """

    def teach(module: Any, name: str) -> None:
        made = getattr(module, name)

        def taught(*arguments: Any, **options: Any) -> Any:
            rendered = made(*arguments, **options)
            oracle.learn(getattr(rendered, "frames", rendered))
            return rendered

        monkeypatch.setattr(module, name, taught)

    return teach


@pytest.fixture
def cases_of() -> Callable[[SuiteResult], dict[str, dict[str, Any]]]:
    """Cases of a result by name, after the checks that writing the benchmark file makes."""

    def cases_of(result: SuiteResult) -> dict[str, dict[str, Any]]:
        document = bench_document(result.suite, "cpu", result.cases, **result.more)
        return {case["case"]: case for case in document["cases"]}

    return cases_of
