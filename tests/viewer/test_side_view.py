"""Side views: the same hand and points, seen from where the style says."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.viewer.depth_colours import EMPTY_COLOUR
from handtrack.viewer.side_view import EYE_DISTANCE, POINT_COLOUR, SidePainter, SideStyle
from oracles.scenes import SMALL_CAMERA, shaped_hand

PANEL = (200, 160)


def painter(**style: float) -> SidePainter:
    return SidePainter(shaped_hand(), SMALL_CAMERA, style=SideStyle(panel=PANEL, **style))


@pytest.mark.parametrize(
    ("turn", "rise", "nearer"),
    [(90, 0, (-1, 0, 0)), (-90, 0, (1, 0, 0)), (0, 90, (0, -1, 0)), (0, 0, (0, 0, -1))],
)
def test_the_eye_is_where_the_style_says(
    depth: np.ndarray, pose: np.ndarray, turn: float, rise: float, nearer: tuple[int, int, int]
) -> None:
    paint = painter(turn=turn, rise=rise)
    paint.paint(depth, pose)
    middle = keypoints(shaped_hand(), pose).mean(axis=0)
    seen = paint._seen(np.stack([middle, middle + 0.1 * np.array(nearer)]))
    np.testing.assert_allclose(seen[0], [0, 0, EYE_DISTANCE], atol=1e-9)
    np.testing.assert_allclose(seen[1], [0, 0, EYE_DISTANCE - 0.1], atol=1e-9)


def test_the_pose_turns_with_the_view(depth: np.ndarray, pose: np.ndarray) -> None:
    paint = painter(turn=60, rise=20)
    paint.paint(depth, pose)
    turned = keypoints(shaped_hand(), paint._seen_pose(pose))
    np.testing.assert_allclose(turned, paint._seen(keypoints(shaped_hand(), pose)), atol=1e-6)


def test_mesh_and_points_are_drawn_and_points_behind_the_mesh_are_not(
    depth: np.ndarray, pose: np.ndarray
) -> None:
    def shares(turn: float, where: np.ndarray | None) -> tuple[float, float]:
        paint = painter(turn=turn, rise=0)
        paint.paint(depth, pose)
        picture = paint.paint(depth, where)
        assert picture.shape == (PANEL[1], PANEL[0], 3) and picture.dtype == np.uint8
        points = (np.abs(picture.astype(int) - POINT_COLOUR).max(axis=-1) < 3).mean()
        return float(points), float((picture != EMPTY_COLOUR).any(axis=-1).mean())

    front, back = shares(0, pose)[0], shares(180, pose)[0]
    assert front > 0.02 and back < 0.25 * front, "from behind the mesh hides them"
    points, drawn = shares(180, None)
    assert points > 0.02 and points == pytest.approx(drawn), "no pose, only points"


def test_nothing_is_known_before_the_first_pose(depth: np.ndarray) -> None:
    assert (painter().paint(depth, None) == EMPTY_COLOUR).all()
    assert (painter().paint(depth, np.full(28, np.nan)) == EMPTY_COLOUR).all()


@pytest.mark.parametrize("bad", [{"span": 0.0}, {"turn": 200.0}, {"rise": 91.0}])
def test_styles_that_make_no_sense_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        SideStyle(**bad)


def test_a_pose_of_another_shape_is_refused(depth: np.ndarray) -> None:
    with pytest.raises(InputError, match="shape"):
        painter().paint(depth, np.zeros(27))
