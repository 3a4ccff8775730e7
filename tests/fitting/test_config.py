"""Settings of the fit: ranges are checked when they are made, not when a frame arrives."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest

from handtrack.errors import HandtrackError, InputError
from handtrack.fitting.config import THESIS, FitConfig


def test_defaults_are_valid_and_frozen() -> None:
    config = FitConfig()
    assert config.crop_cells % config.point_stride == 0
    with pytest.raises(FrozenInstanceError):
        config.damping = 1.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        FitConfig(96)  # type: ignore[misc]


def test_the_thesis_mode_is_point_to_point_with_three_terms() -> None:
    assert THESIS.tangent_weight == 1.0
    assert THESIS.point_weight == FitConfig().point_weight
    for term in ("silhouette_weight", "front_weight", "collision_weight", "prior_weight"):
        assert getattr(THESIS, term) == 0.0
    assert not THESIS.levenberg and THESIS.normal_reach == 0


NUMBERS = [f.name for f in fields(FitConfig) if not isinstance(f.default, bool)]
SIGNED = {"min_cosine", "wrist_cut"}
"""The two that may be negative."""


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5])
def test_values_out_of_range_are_told(name: str, value: float) -> None:
    if name in SIGNED and value == -0.5:
        assert getattr(FitConfig(**{name: value}), name) == value
        return
    with pytest.raises(InputError, match=rf"FitConfig\.{name} is") as caught:
        FitConfig(**{name: value})
    assert isinstance(caught.value, HandtrackError) and isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    "values",
    [
        {"crop_cells": 95},
        {"crop_cells": 8},
        {"crop_cells": 96, "bin_cells": 5},
        {"crop_cells": 96, "point_stride": 7},
        {"crop_cells": 96, "score_scale": 5},
    ],
    ids=str,
)
def test_cells_that_do_not_divide_are_told(values: dict) -> None:
    with pytest.raises(InputError, match=r"crop_cells.*multiple"):
        FitConfig(**values)


@pytest.mark.parametrize("name", ["bin_cells", "point_stride", "score_scale"])
def test_a_divisor_of_zero_is_told(name: str) -> None:
    with pytest.raises(InputError, match="FitConfig"):
        FitConfig(**{name: 0})


@pytest.mark.parametrize(
    "name",
    [
        "crop_cells",
        "crop_span",
        "robust_scale",
        "robust_start",
        "max_translation",
        "max_rotation",
        "max_angle",
    ],
)
def test_a_length_that_must_be_positive_is_told(name: str) -> None:
    with pytest.raises(InputError, match=f"FitConfig.{name}"):
        FitConfig(**{name: 0.0})


@pytest.mark.parametrize("name", ["crop_cells", "point_stride", "iterations", "search_window"])
def test_a_count_that_is_no_whole_number_is_told(name: str) -> None:
    with pytest.raises(InputError, match=f"FitConfig.{name}"):
        FitConfig(**{name: getattr(FitConfig(), name) + 0.5})


@pytest.mark.parametrize("value", ["4", None, [1.0]])
def test_a_value_that_is_no_number_is_told(value: object) -> None:
    with pytest.raises(InputError, match=r"FitConfig\.damping"):
        FitConfig(damping=value)  # type: ignore[arg-type]


def test_a_variant_is_checked_as_well() -> None:
    with pytest.raises(InputError):
        replace(FitConfig(), crop_cells=97)
