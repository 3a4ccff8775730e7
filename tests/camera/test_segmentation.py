import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from handtrack.camera.camera import Camera
from handtrack.camera.frame import check_depth
from handtrack.camera.geodesic import SurfaceGraph
from handtrack.camera.segmentation import (
    ball_box,
    find_hand_regions,
    keep_region,
    region_around,
)
from handtrack.camera.source import open_sequence
from handtrack.errors import InputError

CAMERA = Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)


def paint(depth, camera, shape):
    """Put a flat shape, given as a function of x and y [m] and a z, in front of what is there."""
    inside, z = shape
    v, u = np.mgrid[: camera.height, : camera.width]
    points = camera.unproject(np.stack([u, v], -1), z)
    hit = inside(points[..., 0], points[..., 1]) & ((depth == 0) | (depth > z))
    depth[hit] = z


def box(x0, x1, y0, y1, z):
    return (lambda x, y: (x > x0) & (x < x1) & (y > y0) & (y < y1)), z


def hand(x, y, z):
    """Palm and four fingers pointing up, wrist at (x, y + 0.05)."""
    fingers = [box(x - 0.04 + 0.022 * i, x - 0.026 + 0.022 * i, y - 0.13, y, z) for i in range(4)]
    return [box(x - 0.04, x + 0.04, y - 0.05, y + 0.05, z), *fingers]


def scene(*shapes, camera=CAMERA):
    depth = np.zeros(camera.shape, np.float32)
    for shape in shapes:
        paint(depth, camera, shape)
    return depth


def centre_of_hand(x, y, z):
    return np.array([x, y - 0.03, z])


def test_an_empty_image_has_no_region():
    assert find_hand_regions(np.zeros(CAMERA.shape, np.float32), CAMERA) == []


def test_a_speck_is_no_hand():
    assert find_hand_regions(scene(box(0, 0.02, 0, 0.02, 0.5)), CAMERA) == []


def test_a_hand_alone_is_the_only_region():
    regions = find_hand_regions(scene(*hand(0.05, 0.02, 0.5)), CAMERA)
    assert len(regions) == 1
    region = regions[0]
    assert np.linalg.norm(region.centre - centre_of_hand(0.05, 0.02, 0.5)) < 0.03
    assert region.wrist is None
    # Palm 8 cm x 10 cm and four fingers of 1.4 cm x 8 cm beyond it.
    assert region.area == pytest.approx(80e-4 + 4 * 11.2e-4, rel=0.15)


@pytest.mark.parametrize("z", [0.35, 0.6, 1.2])
def test_hand_in_front_of_a_body_comes_first_at_any_distance(z):
    camera = Camera(width=640, height=480, fx=580.0, fy=580.0, cx=320.0, cy=240.0)
    body = box(-0.25, 0.25, -0.1, 0.6, z + 0.35)
    head = box(-0.08, 0.08, -0.35, -0.1, z + 0.3)
    depth = scene(body, head, *hand(-0.1, 0.0, z), camera=camera)
    first = find_hand_regions(depth, camera)[0]
    assert np.linalg.norm(first.centre - centre_of_hand(-0.1, 0.0, z)) < 0.03


def test_hand_on_an_arm_that_leaves_the_image_is_cut_near_the_wrist():
    arm = box(-0.03, 0.03, -0.01, 0.5, 0.6)
    first = find_hand_regions(scene(arm, *hand(0.0, -0.05, 0.6)), CAMERA)[0]
    assert np.linalg.norm(first.centre - centre_of_hand(0.0, -0.05, 0.6)) < 0.05
    assert first.wrist is not None
    assert -0.03 < first.wrist[1] < 0.05  # the palm ends at y = 0
    assert first.radius < 0.14


def test_two_hands_are_two_regions_and_the_count_is_limited():
    depth = scene(*hand(-0.12, 0.0, 0.5), *hand(0.12, 0.0, 0.55))
    regions = find_hand_regions(depth, CAMERA)
    assert len(regions) == 2
    assert sorted(round(region.centre[0], 1) for region in regions) == [-0.1, 0.1]
    assert len(find_hand_regions(depth, CAMERA, max_regions=1)) == 1
    assert [region.score for region in regions] == sorted(
        (region.score for region in regions), reverse=True
    )


def test_a_wall_alone_is_hardly_plausible():
    for region in find_hand_regions(np.full(CAMERA.shape, 0.8, np.float32), CAMERA):
        assert region.score < 0.05


def test_resolution_changes_little():
    big = CAMERA.resize(640, 480)
    shapes = [box(-0.03, 0.03, -0.01, 0.5, 0.6), *hand(0.0, -0.05, 0.6)]
    low = find_hand_regions(scene(*shapes), CAMERA)[0]
    high = find_hand_regions(scene(*shapes, camera=big), big)[0]
    assert np.linalg.norm(low.centre - high.centre) < 0.015
    assert high.point_count == pytest.approx(4 * low.point_count, rel=0.25)


@settings(deadline=None, max_examples=60)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 20), st.integers(1, 24)),
        elements=st.sampled_from([0.0, 0.3, 0.31, 0.5, 2.0, np.nan, 19.0]),
    )
)
def test_any_clean_image_gives_regions_inside_it(image):
    height, width = image.shape
    camera = Camera(width=width, height=height, fx=8.0, fy=8.0, cx=width / 2, cy=height / 2)
    depth, _ = check_depth(image, camera)
    for region in find_hand_regions(depth, camera):
        left, top, right, bottom = region.box
        assert 0 <= left < right <= width
        assert 0 <= top < bottom <= height
        assert np.isfinite(region.centre).all()
        assert 0 <= region.score <= 1
        assert keep_region(depth, camera, region).any()


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.5), (0.2, -0.1, 0.4), (0.22, 0.2, 0.4)])
def test_ball_box_holds_every_pixel_of_the_ball_and_not_many_more(centre):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pixels = CAMERA.project(np.array(centre) + 0.1 * directions)
    left, top, right, bottom = ball_box(centre, 0.1, CAMERA)
    inside = (
        (pixels[:, 0] > -0.5) & (pixels[:, 0] < 319.5)
        & (pixels[:, 1] > -0.5) & (pixels[:, 1] < 239.5)
    )  # fmt: skip
    seen = pixels[inside]
    assert len(seen) > 100
    assert (seen >= [left - 0.5, top - 0.5]).all()
    assert (seen <= [right - 0.5, bottom - 0.5]).all()
    if centre[0] == 0:  # fully in view: the box is tight
        assert (seen.min(axis=0) - [left, top] < 2).all()
        assert ([right, bottom] - seen.max(axis=0) < 3).all()


def test_ball_around_the_camera_covers_the_image_and_one_behind_it_nothing():
    assert ball_box([0.0, 0.0, 0.05], 0.1, CAMERA) == (0, 0, 320, 240)
    left, top, right, bottom = ball_box([5.0, 0.0, 0.2], 0.1, CAMERA)
    assert (right - left) * (bottom - top) == 0


def test_keep_region_keeps_exactly_the_pixels_inside_the_ball():
    depth = np.random.default_rng(1).uniform(0.35, 0.65, CAMERA.shape).astype(np.float32)
    depth[::5] = 0.0
    region = region_around([[0.02, -0.03, 0.5]], CAMERA, margin=0.1)
    inside = np.linalg.norm(CAMERA.points(depth) - region.centre, axis=-1) <= 0.1
    buffer = np.full(CAMERA.shape, np.nan, np.float32)
    kept = keep_region(depth, CAMERA, region, out=buffer)
    assert kept is buffer
    np.testing.assert_array_equal(kept, np.where(inside, depth, 0.0))


def test_region_around_keypoints_holds_them_all():
    keypoints = np.random.default_rng(2).normal(size=(21, 3)) * 0.04 + [0.05, 0.0, 0.6]
    region = region_around(keypoints, CAMERA, margin=0.03)
    distance = np.linalg.norm(keypoints - region.centre, axis=1)
    assert distance.max() == pytest.approx(region.radius - 0.03)
    left, top, right, bottom = region.box
    pixels = CAMERA.project(keypoints)
    assert ((pixels >= [left, top]) & (pixels <= [right - 1, bottom - 1])).all()


@pytest.mark.parametrize("keypoints", [[], [[np.nan, 0, 1]], [1, 2, 3]])
def test_region_around_nothing_is_refused(keypoints):
    with pytest.raises(InputError, match="keypoints"):
        region_around(keypoints, CAMERA)


def test_distances_along_a_plane_are_its_distances():
    points = CAMERA.points(np.full(CAMERA.shape, 0.5, np.float32))[60:100, 80:160]
    graph = SurfaceGraph(points, np.ones(points.shape[:2], bool))
    distance = graph.distances([0])
    straight = np.linalg.norm(graph.points - graph.points[0], axis=1)
    assert (distance >= straight - 1e-9).all()
    assert (distance <= 1.09 * straight + 1e-9).all()  # eight neighbours: at most 8.3 % longer


def test_a_detour_is_longer_than_the_straight_way():
    mask = np.ones((30, 31), bool)
    mask[:-1, 15] = False
    depth = np.full(CAMERA.shape, 0.5, np.float32)
    graph = SurfaceGraph(CAMERA.points(depth)[:30, :31], mask)
    top_right = int(np.flatnonzero((graph.rows == 0) & (graph.columns == 16))[0])
    top_left = int(np.flatnonzero((graph.rows == 0) & (graph.columns == 14))[0])
    pixel = 0.5 / CAMERA.fx
    assert graph.distances([top_left])[top_right] > 50 * pixel


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [
        "nyu_test_0000001", "nyu_test_0001740_crop",
        "sr305_20210326-230536_130", "sr305_20210326-230536_30", "sr305_20210326-230536_90",
        "sr305_20210326-231615_0", "sr305_20210326-231615_100", "sr305_20210326-231615_180",
    ],
)  # fmt: skip
def test_the_labelled_hand_of_a_real_image_is_the_first_region(name, recordings):
    with open_sequence(recordings / "real" / f"{name}.png") as sequence:
        frame = sequence[0]
    first = find_hand_regions(frame.depth, frame.camera)[0]
    facts = json.loads((recordings / "real" / f"{name}.json").read_text())
    if frame.truth is not None and frame.truth.joints is not None:
        joints = frame.truth.joints
        assert np.linalg.norm(joints.mean(axis=0) - first.centre) < 0.06
        # Labels lie inside the flesh, and the two wrist corners a little outside a hand.
        assert (np.linalg.norm(joints - first.centre, axis=1) < first.radius + 0.02).mean() > 0.85
    else:
        tips = np.array(list(facts["fingertips_px"].values()))
        left, top, right, bottom = first.box
        assert ((tips >= [left, top]) & (tips < [right, bottom])).all()
