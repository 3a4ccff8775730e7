"""Depth in colour: near is bright, steps are even, nothing measured is its own colour."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.viewer.depth_colours import EMPTY_COLOUR, colour_depth, depth_range


def lightness(picture: np.ndarray) -> np.ndarray:
    """Perceived lightness L* of a picture, 0 to 100."""
    return cv2.cvtColor(picture.astype(np.float32) / 255, cv2.COLOR_BGR2Lab)[..., 0]


@pytest.mark.parametrize("grey", [False, True])
def test_lightness_falls_evenly_with_depth(grey: bool) -> None:
    ramp = np.linspace(0.3, 0.7, 201, dtype=np.float32)[None]
    light = lightness(colour_depth(ramp, 0.3, 0.7, grey=grey))[0]
    steps = -np.diff(light[::20])
    assert (steps > 2.5).all(), "near is brighter"
    assert steps.max() < 2.0 * steps.min(), "equal steps look equal"


def test_what_is_not_measured_has_its_own_colour() -> None:
    depth = np.array([[0.0, np.nan, -1.0, np.inf, 0.5, 9.0]], np.float32)
    picture = colour_depth(depth, 0.4, 0.8)[0]
    assert (picture[:4] == EMPTY_COLOUR).all()
    assert (picture[4:] != EMPTY_COLOUR).any(axis=1).all()
    beyond = colour_depth(np.array([[0.8, 9.0, 0.4, 0.1]]), 0.4, 0.8)[0]
    assert (beyond[0] == beyond[1]).all() and (beyond[2] == beyond[3]).all()


def test_the_range_surrounds_the_hand_or_what_there_is() -> None:
    depth = np.zeros((20, 20))
    depth[5:15, 5:15] = np.linspace(0.5, 0.9, 10)
    near, far = depth_range(depth, 0.6)
    assert near < 0.55 and 0.7 < far < 0.9
    near, far = depth_range(depth)
    assert 0.49 < near < 0.55 and 0.85 < far <= 0.95
    for nothing in (np.zeros((4, 4)), np.full((4, 4), np.nan)):
        near, far = depth_range(nothing)
        assert 0 < near < far
    near, far = depth_range(np.full((4, 4), 0.5), float("nan"))
    assert near < far
    with pytest.raises(InputError, match="near < far"):
        colour_depth(depth, 0.5, 0.5)
