"""Pictures of grasps: what is where, what hides what, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.model import HandModel
from handtrack.objects.library import load_object
from handtrack.viewer.grasp_view import (
    BACKGROUND,
    SHADOW,
    TABLE_COLOURS,
    THING_COLOURS,
    GraspPainter,
    GraspStyle,
)

HAND = HandModel.load().shaped()
BOX = load_object("cube_90")
STYLE = GraspStyle(panel=(160, 120), centre=(0.0, 0.0, 0.05), span=0.5, azimuth=120.0, rise=25.0)
AWAY = np.array([0.0, 0.0, -5.0, 1.0, *np.zeros(24)])  # under the table, far from the eye


def hue(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Pixels of about the direction of a colour, whatever the light."""
    values, wanted = picture.astype(float) + 1e-6, np.array(colour, float)
    cosine = (values @ wanted) / (np.linalg.norm(values, axis=2) * np.linalg.norm(wanted))
    return cosine > 0.985


def standing(x: float = 0.0, y: float = 0.0) -> np.ndarray:
    return np.array([x, y, BOX.rest_height, 1.0, 0.0, 0.0, 0.0])


def test_an_object_appears_where_it_stands(device: str) -> None:
    painter = GraspPainter(HAND, [BOX], style=STYLE, device=device)
    picture = painter.paint(AWAY, [standing()])
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    rows, columns = np.nonzero(hue(picture, THING_COLOURS[0]))
    # 90 mm of a view 500 mm wide, centred.
    assert abs(columns.mean() - 79.5) < 4 and abs(rows.mean() - 59.5) < 8
    assert 25 < np.ptp(columns) < 50
    moved = painter.paint(AWAY, [standing(y=0.1)])
    assert abs(np.nonzero(hue(moved, THING_COLOURS[0]))[1].mean() - columns.mean()) > 10


def test_the_hand_hides_what_is_behind_it_and_the_stub_does_not() -> None:
    painter = GraspPainter(HAND, [BOX], style=STYLE)
    bare = painter.paint(AWAY, [standing()])
    pose = AWAY.copy()
    # Between the eye, at azimuth 120 degrees, and the box.
    pose[:3] = [-0.08, 0.12, 0.12]
    covered = painter.paint(pose, [standing()])
    before, after = (hue(p, THING_COLOURS[0]).sum() for p in (bare, covered))
    assert after < 0.9 * before
    # Where the forearm fades, the table shows through: no hole of another colour.
    assert not (covered == 0).all(axis=2).any()


def test_table_and_background_fill_the_rest() -> None:
    picture = GraspPainter(HAND, [BOX], style=STYLE).paint(AWAY, [standing()])
    table = hue(picture, TABLE_COLOURS[0]) | hue(picture, TABLE_COLOURS[1])
    empty = (picture == np.array(BACKGROUND)).all(axis=2)
    assert (table | empty | hue(picture, THING_COLOURS[0])).mean() > 0.97


def test_every_object_has_its_colour() -> None:
    painter = GraspPainter(HAND, [BOX, BOX], style=STYLE)
    picture = painter.paint(AWAY, [standing(y=0.1), standing(y=-0.1)])
    assert all(hue(picture, colour).sum() > 100 for colour in THING_COLOURS[:2])


def shadow(x: float, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of a lifted box's shadow, the box, and brightness lost; seen from well above."""
    style = GraspStyle(panel=(160, 120), centre=(0.0, 0.0, 0.0), span=0.7, azimuth=90.0, rise=60.0)
    painter = GraspPainter(HAND, [BOX], style=style)
    place = standing(x)
    place[2] += height
    picture = painter.paint(AWAY, [place])
    bare = painter.paint(AWAY, [[0.0, 0.0, -5.0, 1.0, 0.0, 0.0, 0.0]])
    thing = hue(picture, THING_COLOURS[0])
    lost = bare.astype(float).sum(2) - picture.astype(float).sum(2)
    return ~thing & (lost > 0.25 * bare.sum(2)), thing, lost


def test_a_lifted_object_shadows_the_table_below_it() -> None:
    # The eye looks along -y from above, x to the left: the table under the box is lower in the
    # picture than the box, by its height times the cosine of the eye's rise.
    lifted, thing, _ = shadow(0.0, 0.2)
    pixels = 160 / 0.7
    rows, columns = np.nonzero(lifted)
    drop = rows.mean() - np.nonzero(thing)[0].mean()
    assert 0.5 * 0.2 * np.cos(np.pi / 3) * pixels < drop
    assert abs(columns.mean() - 79.5) < 0.12 * pixels
    # About as large as the box is from above.
    assert 0.5 < lifted.sum() / (0.09 * pixels) ** 2 < 1.8


def test_a_shadow_goes_with_its_object_and_away_from_it_as_it_rises() -> None:
    here, there = (np.nonzero(shadow(x, 0.2)[0])[1].mean() for x in (0.0, 0.1))
    assert (here - there) * 0.7 / 160 == pytest.approx(0.1, abs=0.02)
    gaps = []
    for height in (0.1, 0.2):
        cast, thing, _ = shadow(0.0, height)
        gaps.append(np.nonzero(cast)[0].mean() - np.nonzero(thing)[0].mean())
    assert gaps[1] > gaps[0] + 5


def test_a_shadow_lies_on_the_table_alone() -> None:
    # Directly over the second box, the first darkens the table around but not the box.
    style = GraspStyle(panel=(160, 120), centre=(0.0, 0.0, 0.0), span=0.7, azimuth=90.0, rise=40.0)
    painter = GraspPainter(HAND, [BOX, BOX], style=style)
    over = standing()
    over[2] = 0.4
    pictures = [painter.paint(AWAY, [first, standing()]) for first in (over, standing(x=5.0))]
    both = np.logical_and(*(hue(picture, THING_COLOURS[1]) for picture in pictures))
    assert both.sum() > 100
    np.testing.assert_array_equal(pictures[0][both], pictures[1][both])


def test_the_hand_casts_a_shadow_too() -> None:
    painter = GraspPainter(HAND, [BOX], style=STYLE)
    pose = AWAY.copy()
    pose[:3] = [-0.1, -0.1, 0.1]
    pictures = [painter.paint(p, [standing()]).astype(float).sum(2) for p in (AWAY, pose)]
    ratio = pictures[1] / pictures[0]
    # Table as dark as full shadow makes it.
    assert (np.abs(ratio - (1.0 - SHADOW)) < 0.05).sum() > 50


def test_bad_poses_and_styles_are_refused() -> None:
    painter = GraspPainter(HAND, [BOX], style=STYLE)
    with pytest.raises(InputError, match=r"expected \(28,\) and \(1, 7\)"):
        painter.paint(AWAY, np.zeros((2, 7)))
    with pytest.raises(InputError, match="rise is"):
        GraspStyle(rise=95.0)
    with pytest.raises(InputError, match="span is"):
        GraspStyle(span=0.0)
