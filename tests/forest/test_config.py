"""Settings of forests are checked where they are made."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handtrack.errors import InputError
from handtrack.forest.config import PRESETS, ForestConfig
from handtrack.forest.growing import VALUE_STEP
from handtrack.kernels.forest_votes import MAX_TREES


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("features", "haar"),
        ("structure", "flat"),
        ("stages", 0),
        ("trees", 0),
        ("trees", 65),
        ("depth", 0),
        ("min_leaf", 0),
        ("candidates", 0),
        ("node_samples", 0),
        ("modes", 0),
        ("leaf_modes", 0),
        ("leaf_modes", 5),
        ("points", 1),
        ("points", 4097),
        ("bag", 0.0),
        ("bag", 1.0),
        ("crop_span", 0.0),
        ("crop_span", 10.0),
        ("gate_radius", -0.1),
        ("gate_radius", float("nan")),
        ("depth_range", 0.0),
        ("depth_range", 0.4),
        ("mode_radius", float("inf")),
        ("crop_cells", 15),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(setting: str, value: object) -> None:
    with pytest.raises(InputError) as caught:
        ForestConfig(**{setting: value})
    assert setting in str(caught.value) and str(value) in str(caught.value)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize(
    "settings",
    [
        {"trees": 64, "leaf_modes": 4, "points": 4096},
        {"stages": 1, "trees": 1, "depth": 1, "min_leaf": 1, "points": 2, "crop_cells": 16},
        {"features": "pose-indexed", "structure": "holistic", "depth_range": 0.3},
    ],
)
def test_settings_at_the_ends_of_their_ranges_are_taken(settings: dict) -> None:
    config = ForestConfig(**settings)
    assert all(getattr(config, name) == value for name, value in settings.items())


def test_the_ranges_are_those_of_the_kernels() -> None:
    largest = ForestConfig(trees=int(MAX_TREES), depth_range=0.3)
    # Depths before and behind the model are kept as 16-bit integers while trees grow.
    assert largest.depth_range / VALUE_STEP < 2**15


@pytest.mark.parametrize("name", PRESETS)
def test_presets_differ_in_size_only(name: str) -> None:
    preset = PRESETS[name]
    assert preset.forest.features == "shape-indexed" and preset.forest.structure == "hierarchical"
    assert preset.dataset.side == "right" and preset.scenes.side == "right"
    # Hands of the scenes must be others than those that are learnt.
    assert preset.scenes.seed != preset.dataset.seed
    assert replace(preset.forest, trees=1).trees == 1
