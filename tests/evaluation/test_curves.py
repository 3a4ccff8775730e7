from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.evaluation.curves import (
    _COLOURS,
    _ticks,
    draw_curves,
    draw_errors_over_time,
    draw_success_curves,
    write_picture,
)


def coloured(image: np.ndarray, curve: int) -> np.ndarray:
    """Rows and columns of the pixels in a curve's pure colour."""
    return np.argwhere((image == _COLOURS[curve]).all(axis=2))


def test_a_rising_line_runs_from_lower_left_to_upper_right() -> None:
    image = draw_curves({"line": ([0, 1], [0, 1])}, "x", "y", "t", size=(640, 480))
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8
    pixels = coloured(image, 0)
    # The legend's sample line is drawn in the same colour, at the lower right.
    rows, columns = pixels[pixels[:, 1] < 400].T
    assert np.corrcoef(rows, columns)[0, 1] < -0.999


def test_gaps_stay_empty() -> None:
    x = np.linspace(0, 1, 101)
    y = np.full(101, 0.5)
    y[40:60] = np.nan
    image = draw_curves({"gap": (x, y)}, "x", "y", "t", x_range=(0, 1), y_range=(0, 1))
    middle = coloured(image, 0)
    middle = middle[np.abs(middle[:, 0] - np.median(middle[:, 0])) < 5]
    place = (middle[:, 1] - 84) / (880 - 84 - 28)
    assert not ((place > 0.42) & (place < 0.57)).any()
    assert (place < 0.3).any() and (place > 0.7).any()


def test_curves_outside_the_axes_are_clipped() -> None:
    image = draw_curves(
        {"far": ([0, 1, 2], [-1e9, 0.5, 1e30])}, "x", "y", "t", x_range=(0, 2), y_range=(0, 1)
    )
    rows, columns = coloured(image, 0).T
    assert rows.min() >= 56 and rows.max() < 560 - 66
    assert columns.min() >= 84 and columns.max() < 880 - 28


def test_one_colour_per_curve_and_success_runs_from_0_to_100(rng: np.random.Generator) -> None:
    errors = {name: rng.gamma(2.0, size, (300, 14)) for name, size in (("a", 3.0), ("b", 8.0))}
    image = draw_success_curves(errors)
    assert len(coloured(image, 0)) > 200 and len(coloured(image, 1)) > 200
    # The better method is higher up: smaller rows at the same column.
    column = 84 + (880 - 84 - 28) // 4
    heights = [np.median(p[p[:, 1] == column][:, 0]) for p in (coloured(image, k) for k in (0, 1))]
    assert heights[0] < heights[1]


def test_errors_over_time_takes_frames_or_joints(rng: np.random.Generator) -> None:
    errors = rng.gamma(2.0, 3.0, (2000, 14))
    one = draw_errors_over_time({"a": errors})
    two = draw_errors_over_time({"a": errors.mean(axis=1)}, frames=np.arange(2000))
    assert (one == two).all()
    assert len(coloured(draw_errors_over_time({"a": np.zeros(5)}), 0)) > 50


@pytest.mark.parametrize(
    ("ends", "expected"),
    [((0, 1), [0, 0.2, 0.4, 0.6, 0.8, 1.0]), ((0, 80), [0, 20, 40, 60, 80]), ((3, 4000), None)],
)
def test_ticks_are_round_numbers(ends: tuple[float, float], expected: list[float] | None) -> None:
    ticks = _ticks(ends, 5)
    if expected is not None:
        assert ticks == pytest.approx(expected)
    assert 3 <= len(ticks) <= 9 and ticks[0] >= ends[0] and ticks[-1] <= ends[1]


def test_unusable_curves_are_refused() -> None:
    for curves, words in (
        ({}, "no curves"),
        ({"a": ([0, 1], [0])}, "'a'"),
        ({"a": ([], [])}, "'a'"),
        ({"a": ([0, 1], [np.nan, np.nan])}, "no finite point"),
    ):
        with pytest.raises(InputError, match=words):
            draw_curves(curves, "x", "y", "t")
    with pytest.raises(InputError, match="too small"):
        draw_curves({"a": ([0, 1], [0, 1])}, "x", "y", "t", size=(100, 100))


def test_pictures_are_written_or_the_reason_told(tmp_path: Path) -> None:
    image = draw_curves({"a": ([0, 1], [0, 1])}, "x", "y", "t")
    write_picture(tmp_path / "a.png", image)
    assert (cv2.imread(str(tmp_path / "a.png")) == image).all()
    for bad in (tmp_path / "none" / "a.png", tmp_path / "a.unknown"):
        with pytest.raises(InputError, match="cannot write"):
            write_picture(bad, image)
