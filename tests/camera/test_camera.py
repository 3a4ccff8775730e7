import dataclasses
import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtrack.camera.camera import Camera
from handtrack.errors import InputError

CAMERA = Camera(width=320, height=240, fx=241.42, fy=240.0, cx=158.3, cy=121.7)


def test_point_on_the_axis_projects_to_the_principal_point():
    assert CAMERA.project([0.0, 0.0, 0.7]) == pytest.approx([158.3, 121.7])


def test_x_is_right_and_y_is_down():
    u, v = CAMERA.project([0.1, 0.05, 0.5])
    assert (u, v) == pytest.approx((158.3 + 241.42 * 0.2, 121.7 + 240.0 * 0.1))


@settings(deadline=None)
@given(st.floats(-500, 900), st.floats(-500, 900), st.floats(0.05, 10.0), st.sampled_from([1, 3]))
def test_projecting_an_unprojected_pixel_gives_it_back(u, v, z, copies):
    pixels = np.tile([u, v], (copies, 2, 1))
    points = CAMERA.unproject(pixels, np.full((copies, 2), z))
    assert points.shape == (copies, 2, 3)
    np.testing.assert_allclose(CAMERA.project(points), pixels, atol=1e-9)


def test_points_behind_the_camera_have_no_pixel():
    pixels = CAMERA.project([[0.0, 0.0, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_float32_stays_float32_and_other_types_become_float64():
    assert CAMERA.project(np.ones((2, 3), np.float32)).dtype == np.float32
    assert CAMERA.project(np.ones((2, 3), np.int32)).dtype == np.float64


def test_points_of_a_depth_image_equal_unprojection_pixel_by_pixel():
    depth = np.random.default_rng(1).uniform(0.2, 1.0, CAMERA.shape).astype(np.float32)
    depth[::7, ::5] = 0.0
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    expected = CAMERA.unproject(np.stack([u, v], -1), depth)
    points = CAMERA.points(depth)
    np.testing.assert_allclose(points, expected, atol=1e-6)  # float32 rounding at one metre
    assert not points[depth == 0].any()


def test_points_of_another_size_are_refused():
    with pytest.raises(InputError, match=r"\(240, 320\)"):
        CAMERA.points(np.zeros((320, 240), np.float32))


def test_crop_sees_the_same_pixels():
    crop = CAMERA.crop(30, 12, 100, 80)
    point = [0.03, -0.02, 0.6]
    assert crop.shape == (80, 100)
    np.testing.assert_allclose(crop.project(point), CAMERA.project(point) - [30, 12])


@pytest.mark.parametrize("size", [(160, 120), (640, 480), (200, 90)])
def test_resize_follows_the_pixel_centre_rule_of_opencv(size):
    # A plane tilted in x and y is linear in 1/z; linear interpolation of it must stay true.
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    smaller = cv2.resize(np.stack([u, v], -1), size, interpolation=cv2.INTER_LINEAR)
    camera = CAMERA.resize(*size)
    middle = (size[1] // 2, size[0] // 2)
    point = CAMERA.unproject(smaller[middle], 0.5)
    np.testing.assert_allclose(camera.project(point), middle[::-1], atol=1e-9)


def test_resize_keeps_the_view_and_undoes_itself():
    there = CAMERA.resize(97, 61)
    back = there.resize(CAMERA.width, CAMERA.height)
    for name, value in CAMERA.to_dict().items():
        assert getattr(back, name) == pytest.approx(value)
    corner = CAMERA.unproject([-0.5, -0.5], 1.0)
    np.testing.assert_allclose(there.project(corner), [-0.5, -0.5], atol=1e-12)


def test_scaled_rounds_to_whole_pixels():
    assert CAMERA.scaled(0.5) == CAMERA.resize(160, 120)
    assert CAMERA.scaled(0.001).shape == (1, 1)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_thin_is_the_camera_of_a_strided_image(step):
    depth = np.random.default_rng(2).uniform(0.2, 1.0, CAMERA.shape).astype(np.float32)
    thin = depth[::step, ::step]
    camera = CAMERA.thin(step)
    assert camera.shape == thin.shape
    expected = CAMERA.points(depth)[::step, ::step]
    np.testing.assert_allclose(camera.points(thin), expected, atol=1e-6)


def test_dict_survives_json():
    assert Camera.from_dict(json.loads(json.dumps(CAMERA.to_dict()))) == CAMERA


def test_numpy_values_become_plain_numbers():
    camera = Camera(
        width=np.int64(4), height=np.float32(3), fx=np.float32(2), fy=2, cx=np.float64(1), cy=1
    )
    assert json.dumps(camera.to_dict())
    assert type(camera.height) is int


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0), ("width", 2.5), ("width", -3), ("height", 10**9), ("height", "240"),
        ("fx", 0.0), ("fx", -1.0), ("fy", float("nan")), ("cx", float("inf")), ("cy", None),
        ("fx", True), ("fx", [1.0, 2.0]),
    ],
)  # fmt: skip
def test_impossible_intrinsics_are_refused_by_name(field, value):
    with pytest.raises(InputError, match=field):
        dataclasses.replace(CAMERA, **{field: value})


def test_incomplete_dict_tells_what_is_missing():
    with pytest.raises(InputError, match="lacks fy, cx"):
        Camera.from_dict({"width": 3, "height": 2, "fx": 1.0, "cy": 1.0})
    with pytest.raises(InputError, match="mapping"):
        Camera.from_dict([1, 2, 3])  # type: ignore[arg-type]


def test_wrong_last_axis_is_refused():
    with pytest.raises(InputError, match="expected"):
        CAMERA.project(np.zeros((4, 2)))
    with pytest.raises(InputError, match="expected"):
        CAMERA.unproject(np.zeros((4, 3)), 1.0)
