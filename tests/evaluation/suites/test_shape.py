"""Suite `shape`: what its cases hold, and how lengths are measured."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.report import check_case
from handtrack.evaluation.suites.shape import ShapeError, hand_length
from handtrack.evaluation.suites.suite import SuiteSettings, run_suite
from oracles.scenes import shaped_hand


def test_errors_of_a_larger_hand_are_its_growth() -> None:
    hand = shaped_hand()
    found = ShapeError.of(hand.scaled(1.05), hand)
    np.testing.assert_allclose(found.bones, 50.0 * hand.bone_lengths)
    assert found.length == pytest.approx(50.0 * hand_length(hand))
    assert 0.18 < hand_length(hand) < 0.20
    assert 0.5 < found.surface < 3.0


@pytest.mark.slow
def test_the_quick_suite_fits_better_than_the_mean_hand() -> None:
    result = run_suite("shape", SuiteSettings(quick=True, device="cpu", subjects=(12,)))
    cases = {case["case"]: case for case in result.cases}
    for case in cases.values():
        check_case(case)
        for name in ("bone_length_error_mm", "surface_error_mm", "hand_length_error_mm"):
            assert set(case[name]) == {"mean", "p95"}
    fitted, mean = cases["fitted"], cases["mean-hand"]
    assert fitted["bone_length_error_mm"]["mean"] < 0.5 * mean["bone_length_error_mm"]["mean"]
    assert fitted["seconds"]["mean"] > 0
    assert len(result.overlays) == 12
    assert {target.value for target in result.targets} >= {"seconds.mean"}


def test_other_suites_do_not_fit_shapes() -> None:
    with pytest.raises(InputError, match="does not fit shapes"):
        run_suite("speed", SuiteSettings(shape="fitted"))
