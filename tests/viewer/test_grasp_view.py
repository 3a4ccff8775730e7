"""Pictures of grasps: what is where, what hides what, bad input."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.model import HandModel
from handtrack.objects.library import load_object
from handtrack.viewer.grasp_view import (
    BACKGROUND,
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


def test_bad_poses_and_styles_are_refused() -> None:
    painter = GraspPainter(HAND, [BOX], style=STYLE)
    with pytest.raises(InputError, match=r"expected \(28,\) and \(1, 7\)"):
        painter.paint(AWAY, np.zeros((2, 7)))
    with pytest.raises(InputError, match="rise is"):
        GraspStyle(rise=95.0)
    with pytest.raises(InputError, match="span is"):
        GraspStyle(span=0.0)
