"""What the fit writes is allocated once, and parts of it are views."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import warp as wp

from handtrack.fitting.config import THESIS, FitConfig
from handtrack.fitting.workspace import HandArrays, RowArrays, point_directions


@pytest.fixture
def rows(device: str) -> RowArrays:
    return RowArrays.allocate(3, 2, 50, 45, FitConfig(crop_cells=32), wp.get_device(device))


def test_rows_are_ordered_by_hand(rows: RowArrays) -> None:
    np.testing.assert_array_equal(rows.row_hand.numpy(), [0, 0, 1, 1, 2, 2])


def test_every_array_has_one_entry_per_row(rows: RowArrays) -> None:
    for field in fields(RowArrays):
        assert getattr(rows, field.name).shape[0] == 6, field.name


def test_every_image_array_has_one_entry_per_hand(device: str) -> None:
    image = HandArrays.allocate(3, 12, 16, FitConfig(crop_cells=32), wp.get_device(device))
    assert image.depth.shape == (3, 12, 16)
    assert image.cells.shape == (3, 32, 32)
    for field in fields(HandArrays):
        if field.name != "intrinsics":
            assert getattr(image, field.name).shape[0] == 3, field.name


def test_a_part_is_a_view_of_its_rows(rows: RowArrays) -> None:
    part = rows.part(2, 5)
    for field in fields(RowArrays):
        whole, some = getattr(rows, field.name), getattr(part, field.name)
        assert some.shape == (3, *whole.shape[1:]), field.name
        assert some.is_contiguous, field.name
    part.pose.fill_(7.0)
    np.testing.assert_array_equal(rows.pose.numpy()[:, 0], [0, 0, 7, 7, 7, 0])
    # Rows name their hand among all hands, not among the part's.
    np.testing.assert_array_equal(part.row_hand.numpy(), [1, 1, 2])


def test_parts_cover_all_rows_once(rows: RowArrays) -> None:
    for number, (start, stop) in enumerate([(0, 2), (2, 3), (3, 6)]):
        rows.part(start, stop).pose.fill_(float(number + 1))
    np.testing.assert_array_equal(rows.pose.numpy()[:, 27], [1, 1, 2, 3, 3, 3])


def test_unused_residuals_count_for_nothing_from_the_start(rows: RowArrays) -> None:
    assert (rows.chains.numpy() == -2).all()
    assert not rows.costs.numpy().any()


def test_points_have_three_residuals_only_when_tangents_weigh() -> None:
    assert point_directions(FitConfig()) == 1
    assert point_directions(THESIS) == 3
    assert point_directions(FitConfig(tangent_weight=0.1)) == 3
