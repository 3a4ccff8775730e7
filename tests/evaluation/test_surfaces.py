"""Distances between surfaces of hands."""

from __future__ import annotations

import pytest

from handtrack.evaluation.surfaces import rest_surface_distance
from oracles.scenes import shaped_hand


def test_a_hand_is_no_distance_from_itself_and_some_from_a_larger_one() -> None:
    hand = shaped_hand("right", 2)
    assert rest_surface_distance(hand, hand) == pytest.approx(0.0, abs=1e-9)
    near, far = (rest_surface_distance(hand, hand.scaled(s)) for s in (1.02, 1.04))
    assert 0.0003 < near < far < 0.003
    assert far == pytest.approx(rest_surface_distance(hand.scaled(1.04), hand))
