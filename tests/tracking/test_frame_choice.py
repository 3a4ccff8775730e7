"""Which frames are chosen: those that tell what the others do not."""

from __future__ import annotations

import numpy as np

from handtrack.tracking.frame_choice import most_telling, worth


def test_what_is_not_known_yet_is_chosen() -> None:
    along = [np.diag(values) for values in ([9.0, 0, 0], [8.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0])]
    assert most_telling(np.stack(along), np.eye(3), 3) == [0, 2, 3]


def test_no_more_are_chosen_than_there_are() -> None:
    assert sorted(most_telling(np.stack([np.eye(2)] * 2), np.eye(2), 5)) == [0, 1]


def test_images_that_differ_are_worth_more() -> None:
    first, second = np.diag([4.0, 0.0]), np.diag([0.0, 4.0])
    assert worth([first, second], np.eye(2)) > worth([first, first], np.eye(2))
