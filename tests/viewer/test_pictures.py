"""Overlay pictures: the mesh where the hand is, the skeleton where the joints are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.result import HandResult, TrackState
from handtrack.viewer.depth_colours import EMPTY_COLOUR
from handtrack.viewer.pictures import (
    FINGER_COLOURS,
    OverlayPainter,
    PictureStyle,
    contact_sheet,
    draw_skeleton,
)
from oracles.scenes import SMALL_CAMERA, seen_poses, shaped_hand

PLAIN = PictureStyle(panel=(320, 240), text=False, skeleton=False, side_by_side=False)
"""Mesh over depth, twice the camera's size."""


def painter(style: PictureStyle) -> OverlayPainter:
    return OverlayPainter(shaped_hand(), SMALL_CAMERA, style=style)


def changed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pixels that differ visibly."""
    return np.abs(one.astype(int) - other).max(axis=-1) > 3


def test_the_mesh_covers_the_hand_and_nothing_else(depth: np.ndarray, pose: np.ndarray) -> None:
    paint = painter(PLAIN)
    with_mesh = paint.paint(depth, pose)
    paint = painter(replace(PLAIN, mesh_opacity=0.0))
    without = paint.paint(depth, pose)
    mesh = changed(with_mesh, without)
    hand = np.kron(depth > 0, np.ones((2, 2), bool))
    # The stub of forearm fades, and outlines are finer than the camera's pixels.
    assert mesh[hand].mean() > 0.75
    assert mesh[~hand].mean() < 0.02
    assert len(np.unique(with_mesh[mesh], axis=0)) > 200, "shaded, not flat"
    assert (without[~hand] == EMPTY_COLOUR).all()


def test_light_comes_from_above(depth: np.ndarray) -> None:
    style = replace(PLAIN, tint=0.0)
    sphere_like = seen_poses(shaped_hand(), np.random.default_rng(1), 1, turn=0.0, bend=0.0)[0]
    picture = painter(style).paint(np.zeros_like(depth), sphere_like).astype(float).sum(-1)
    middle = SMALL_CAMERA.project(keypoints(shaped_hand(), sphere_like)[8]) * 2
    # Across the index fingertip, the upper left side is lit, the lower right one is not.
    u, v = np.rint(middle).astype(int)
    patch = picture[v - 12 : v + 13, u - 12 : u + 13]
    mesh = patch > sum(EMPTY_COLOUR) + 60
    columns = np.nonzero(mesh)[1]
    left = patch[mesh & (np.arange(25)[None] < np.median(columns))].mean()
    right = patch[mesh & (np.arange(25)[None] > np.median(columns))].mean()
    assert left > 1.05 * right


def test_what_is_measured_before_the_mesh_hides_it(depth: np.ndarray, pose: np.ndarray) -> None:
    blocked = depth.copy()
    rows, columns = np.nonzero(depth)
    top, left = int(np.median(rows)) - 8, int(np.median(columns)) - 8
    blocked[top : top + 16, left : left + 16] = depth[depth > 0].min() - 0.1
    style = replace(PLAIN, hidden_opacity=0.0)
    covered = painter(style).paint(blocked, pose)
    bare = painter(replace(style, mesh_opacity=0.0)).paint(blocked, pose)
    inside = slice(2 * top + 6, 2 * top + 26), slice(2 * left + 6, 2 * left + 26)
    assert not changed(covered, bare)[inside].any()
    assert changed(covered, bare).sum() > 1000


def test_keypoints_are_drawn_where_they_project(depth: np.ndarray, pose: np.ndarray) -> None:
    style = replace(PLAIN, skeleton=True, mesh_opacity=0.0)
    picture = painter(style).paint(depth, pose)
    view = SMALL_CAMERA.resize(320, 240)
    pixels = np.rint(view.project(keypoints(shaped_hand(), pose))).astype(int)
    for finger in range(5):
        u, v = pixels[4 + 4 * finger]
        assert np.abs(picture[v, u].astype(int) - FINGER_COLOURS[finger]).max() < 40


def test_zoom_puts_the_hand_into_the_middle(depth: np.ndarray, pose: np.ndarray) -> None:
    moved = pose.copy()
    moved[:3] += [0.08, -0.05, 0.1]
    image = DepthRenderer(shaped_hand(), SMALL_CAMERA, device="cpu", batch=1).render(moved[None])[0]
    style = replace(PLAIN, panel=(200, 200), zoom=0.3)
    picture = painter(style).paint(image, moved)
    bright = (picture != EMPTY_COLOUR).any(-1)
    rows, columns = np.nonzero(bright)
    assert abs(rows.mean() - 100) < 30 and abs(columns.mean() - 100) < 30
    # 0.3 m of a hand 0.18 m long fill the view; the mesh and the depth are enlarged alike.
    assert 0.1 < bright.mean() < 0.6
    bare = painter(replace(style, mesh_opacity=0.0)).paint(image, moved)
    grown = (bare != EMPTY_COLOUR).any(-1)
    assert (bright & ~grown).mean() < 0.03


def test_the_view_follows_gently_until_a_cut(depth: np.ndarray, pose: np.ndarray) -> None:
    style = replace(PLAIN, zoom=0.3, mesh_opacity=0.0, skeleton=True)
    far = pose.copy()
    far[0] += 0.1
    paint, fresh = painter(style), painter(style)
    paint.paint(depth, pose)
    followed, cut = paint.paint(depth, far), fresh.paint(depth, far)
    assert changed(followed, cut).any()
    paint.cut()
    assert not changed(paint.paint(depth, far), cut).any()


@pytest.mark.parametrize("state", list(TrackState))
@pytest.mark.parametrize("zoom", [None, 0.3])
def test_every_state_gives_a_picture(
    depth: np.ndarray, pose: np.ndarray, state: TrackState, zoom: float | None
) -> None:
    lost = state is TrackState.NO_HAND
    result = HandResult(
        state=state, side="right", pose=np.full(28, np.nan) if lost else pose, hand=shaped_hand(),
        depth_error=np.nan if lost else 0.004, problem="the depth holds nothing " * 9,
    )  # fmt: skip
    style = PictureStyle(panel=(320, 240), zoom=zoom)
    paint = painter(style)
    picture = paint.paint_result(depth, result, index=12)
    assert picture.shape == (240, 640, 3) and picture.dtype == np.uint8
    assert paint.size == (640, 240)
    silent = painter(replace(style, text=False)).paint_result(depth, result, index=12)
    text = changed(picture, silent)
    assert text[:, :320].any() and text[:, 320:].any(), "frame on the left, state on the right"


@pytest.mark.parametrize(
    "bad",
    [
        lambda depth: np.zeros_like(depth),
        lambda depth: np.full_like(depth, np.nan),
        lambda depth: -depth,
        lambda depth: depth * 1e30,
        lambda depth: depth.astype(np.float64)[:, ::-1],
    ],
    ids=["zero", "nan", "negative", "huge", "flipped view"],
)
def test_bad_depth_is_drawn_without_complaint(
    depth: np.ndarray, pose: np.ndarray, bad: object
) -> None:
    paint = painter(PictureStyle(panel=(320, 240)))
    with np.errstate(all="raise", under="ignore"):
        picture = paint.paint(bad(depth), pose)  # type: ignore[operator]
    assert picture.shape == (240, 640, 3)
    for outside in (np.array([0, 0, -0.4]), np.array([9.0, 9, 0.5]), np.array([0, 0, 1e6])):
        away = pose.copy()
        away[:3] = outside
        assert paint.paint(depth, away).shape == (240, 640, 3)


def test_wrong_shapes_and_settings_are_refused(depth: np.ndarray, pose: np.ndarray) -> None:
    paint = painter(PLAIN)
    with pytest.raises(InputError, match=r"expected \(120, 160\)"):
        paint.paint(depth[:50], pose)
    with pytest.raises(InputError, match="expected \\(28,\\)"):
        paint.paint(depth, pose[:27])
    for change in ({"panel": (10, 10)}, {"zoom": 0.0}, {"tint": 2.0}, {"supersample": 9}):
        with pytest.raises(InputError):
            replace(PLAIN, **change)


def test_keypoints_that_are_not_finite_are_left_out() -> None:
    picture = np.zeros((100, 100, 3), np.uint8)
    draw_skeleton(picture, np.full((21, 2), np.nan))
    assert not picture.any()
    pixels = np.full((21, 2), np.nan)
    pixels[8] = [50, 40]
    pixels[4] = [1e12, -1e12]
    draw_skeleton(picture, pixels)
    assert (picture[40, 50] == FINGER_COLOURS[1]).all() and not picture[:, :30].any()


def test_a_contact_sheet_lays_pictures_out_in_rows() -> None:
    pictures = [np.full((4, 6, 3), value, np.uint8) for value in (10, 20, 30)]
    sheet = contact_sheet(pictures, 2, gap=2)
    assert sheet.shape == (10, 14, 3)
    assert (sheet[:4, :6] == 10).all() and (sheet[:4, 8:] == 20).all()
    assert (sheet[6:, :6] == 30).all() and (sheet[6:, 8:] == 255).all()
    with pytest.raises(InputError, match="some"):
        contact_sheet([], 2)
    with pytest.raises(InputError, match="differ in size"):
        contact_sheet([pictures[0], pictures[1][:3]], 2)
