import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from handtrack.camera.camera import Camera
from handtrack.camera.frame import MAX_DEPTH, check_depth

CAMERA = Camera(width=12, height=9, fx=10.0, fy=10.0, cx=6.0, cy=4.0)
GOOD = np.random.default_rng(0).uniform(0.3, 1.2, CAMERA.shape).astype(np.float32)

anything = st.one_of(
    st.none(),
    st.text(max_size=5),
    st.integers(),
    st.lists(st.lists(st.floats(), max_size=3), max_size=4),
    st.dictionaries(st.text(max_size=2), st.integers(), max_size=2),
    hnp.arrays(
        dtype=st.one_of(
            hnp.scalar_dtypes(), hnp.unicode_string_dtypes(max_len=3), hnp.byte_string_dtypes()
        ),
        shape=st.one_of(
            st.just(CAMERA.shape), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
        ),
    ),
)
float_images = hnp.arrays(
    dtype=st.sampled_from([np.float16, np.float32, np.float64, np.dtype(">f4")]),
    shape=CAMERA.shape,
    elements=st.floats(width=16),
)


@settings(deadline=None)
@given(anything)
def test_whatever_is_passed_a_clean_image_comes_out(thing):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clean, problem = check_depth(thing, CAMERA)
    assert clean.dtype == np.float32
    assert clean.shape == CAMERA.shape
    assert clean.flags.c_contiguous
    assert np.isfinite(clean).all()
    assert clean.min() >= 0
    assert clean.max() <= MAX_DEPTH
    assert (problem is None) == bool(clean.any())


@settings(deadline=None)
@given(float_images)
def test_exactly_the_measured_pixels_survive(image):
    clean, _ = check_depth(image, CAMERA)
    values = image.astype(np.float64)
    measured = np.isfinite(values) & (values > 0) & (values <= MAX_DEPTH)
    np.testing.assert_array_equal(clean, np.where(measured, values, 0).astype(np.float32))


@pytest.mark.parametrize(
    "image",
    [
        GOOD.astype(np.float64),
        np.asfortranarray(GOOD),
        np.repeat(GOOD, 2, axis=1)[:, ::2],
        GOOD[::-1][::-1],
        GOOD.astype(">f4"),
        np.ma.masked_less(GOOD, 0.1),
        GOOD.tolist(),
    ],
    ids=["float64", "fortran", "strided", "reversed", "big-endian", "masked", "nested list"],
)
def test_any_float_layout_gives_the_same_image(image):
    clean, problem = check_depth(image, CAMERA)
    assert problem is None
    np.testing.assert_array_equal(clean, GOOD)


def test_masked_pixels_are_not_measured():
    clean, _ = check_depth(np.ma.masked_greater(GOOD, 0.7), CAMERA)
    np.testing.assert_array_equal(clean, np.where(GOOD > 0.7, 0, GOOD))


@pytest.mark.parametrize("dtype", [np.uint16, np.uint8, np.int32, np.int64])
def test_integer_depth_is_refused_because_its_unit_is_unknown(dtype):
    clean, problem = check_depth(np.full(CAMERA.shape, 100, dtype), CAMERA)
    assert not clean.any()
    assert problem is not None
    assert np.dtype(dtype).name in problem
    assert "unit" in problem


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((12, 9), np.float32), "shape"),
        (np.zeros((9, 12, 1), np.float32), "shape"),
        (np.zeros((0, 0), np.float32), "shape"),
        (np.full(CAMERA.shape, np.nan, np.float32), "no measurement"),
        (np.full(CAMERA.shape, -1.0, np.float32), "no measurement"),
        (np.full(CAMERA.shape, 800.0, np.float32), "no measurement"),
        (np.full(CAMERA.shape, np.inf, np.float64), "no measurement"),
        (np.full(CAMERA.shape, 1e300), "no measurement"),
        (np.ones(CAMERA.shape, bool), "bool"),
        (np.ones(CAMERA.shape, complex), "complex"),
        (np.full(CAMERA.shape, None), "object"),
        ([[1.0], [2.0, 3.0]], "list"),
    ],
)
def test_unusable_images_are_explained(image, words):
    clean, problem = check_depth(image, CAMERA)
    assert not clean.any()
    assert problem is not None
    assert words in problem


def test_object_that_refuses_to_become_an_array_is_explained():
    class Hostile:
        def __array__(self, dtype=None, copy=None):
            raise RuntimeError("on another device")

    clean, problem = check_depth(Hostile(), CAMERA)
    assert not clean.any()
    assert problem is not None
    assert "Hostile" in problem


def test_the_callers_image_is_neither_changed_nor_kept():
    image = GOOD.copy()
    image[0, 0] = np.nan
    before = image.copy()
    clean, _ = check_depth(image, CAMERA)
    np.testing.assert_array_equal(image, before)
    assert not np.shares_memory(clean, image)


def test_a_buffer_given_is_filled_and_returned():
    buffer = np.full(CAMERA.shape, np.nan, np.float32)
    clean, problem = check_depth(GOOD, CAMERA, out=buffer)
    assert clean is buffer
    assert problem is None
    clean, problem = check_depth("nonsense", CAMERA, out=buffer)
    assert clean is buffer
    assert not buffer.any()
