"""Whatever comes instead of a depth image: no exception, no NaN, a state that says so."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtrack.camera.camera import Camera
from handtrack.camera.frame import MAX_DEPTH, DepthFrame
from handtrack.errors import InputError
from handtrack.hand.skeleton import NQ
from handtrack.synthesis.motion import Motion
from handtrack.synthesis.noise import TIME_OF_FLIGHT
from handtrack.synthesis.sequence import synthesize_sequence
from handtrack.tracking.result import HandResult, TrackState
from handtrack.tracking.tracker import HandTracker
from oracles.scenes import shaped_hand

CAMERA = Camera(width=160, height=120, fx=120.71, fy=120.71, cx=79.5, cy=59.5)
FOUND = (TrackState.TRACKING, TrackState.RECOVERED)


@cache
def frames(side: str = "right") -> list[DepthFrame]:
    """Some frames of a moving hand with its forearm, as a noisy sensor sees them."""
    motion = Motion.load("recorded_hand_motion").take(817, 829)
    return list(
        synthesize_sequence(motion, shaped_hand(side), CAMERA, TIME_OF_FLIGHT, device="cpu")
    )


@cache
def tracker(side: str = "right") -> HandTracker:
    """One tracker for all tests of a side; `reset` forgets the past."""
    return HandTracker(CAMERA, side=side, device="cpu", tracker="model_based")


def first_pose(side: str = "right") -> np.ndarray:
    truth = frames(side)[0].truth
    assert truth is not None and truth.pose is not None
    return truth.pose


def error_mm(result: HandResult, frame: DepthFrame) -> float:
    """Mean distance of the keypoints from their true places [mm]."""
    assert frame.truth is not None and frame.truth.keypoints is not None
    return 1e3 * float(np.linalg.norm(result.keypoints - frame.truth.keypoints, axis=1).mean())


def check_finite(result: HandResult) -> None:
    """A pose that was ever found stays a pose."""
    assert np.isfinite(result.pose).all() and np.isfinite(result.keypoints).all()
    assert abs(np.linalg.norm(result.pose[3:7]) - 1.0) < 1e-6
    assert np.isfinite(result.vertices).all()


def follow(side: str, bad: Any) -> None:
    """A good frame, a bad one, a good one."""
    track = tracker(side)
    track.reset(first_pose(side))
    good = frames(side)
    before = track.track(good[0].depth)
    assert before.state is TrackState.TRACKING and error_mm(before, good[0]) < 10
    result = track.track(bad)
    assert result.state is TrackState.LOST
    assert result.problem, "the result says why"
    check_finite(result)
    np.testing.assert_array_equal(result.pose, before.pose)
    after = track.track(good[1].depth)
    assert after.state is TrackState.RECOVERED and after.problem is None
    check_finite(after)
    assert error_mm(after, good[1]) < 25
    assert track.track(good[2].depth).state is TrackState.TRACKING


UNUSABLE: dict[str, Callable[[np.ndarray], Any]] = {
    "empty": np.zeros_like,
    "all NaN": lambda good: np.full_like(good, np.nan),
    "all infinite": lambda good: np.full_like(good, np.inf),
    "negative": lambda good: -good,
    "huge": lambda good: good * np.float32(1e30),
    "millimetres": lambda good: good * np.float32(1e3),
    "integer": lambda good: (good * 1000).astype(np.uint16),
    "bool": lambda good: good > 0,
    "complex": lambda good: good.astype(complex),
    "objects": lambda good: good.astype(object),
    "wrong size": lambda good: good[:-1],
    "transposed": lambda good: good.T,
    "one pixel": lambda good: good[:1, :1],
    "no pixel": lambda good: good[:0],
    "three channels": lambda good: np.stack([good] * 3, -1),
    "nothing": lambda good: None,
    "text": lambda good: "depth.png",
    "ragged": lambda good: [[1.0, 2.0], [3.0]],
    "constant": lambda good: np.full_like(good, 3.0),
    "a wall at the hand": lambda good: np.full_like(good, np.median(good[good > 0])),
    "sensor noise only": lambda good: np.random.default_rng(0).random(good.shape),
    "single pixels": lambda good: np.where(np.arange(good.size).reshape(good.shape) % 997, 0, good),
    "the hand has gone": lambda good: np.roll(good, 70, axis=1),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_a_bad_frame_is_told_and_the_next_good_one_tracks_again(kind: str) -> None:
    with np.errstate(all="ignore"):
        bad = UNUSABLE[kind](frames()[0].depth)
    follow("right", bad)


@pytest.mark.parametrize("kind", ["all NaN", "wrong size", "a wall at the hand"])
def test_a_left_hand_tracks_again_too(kind: str) -> None:
    follow("left", UNUSABLE[kind](frames("left")[0].depth))


USABLE: dict[str, Callable[[np.ndarray], Any]] = {
    "double precision": lambda good: good.astype(np.float64),
    "half precision": lambda good: good.astype(np.float16),
    "Fortran order": np.asfortranarray,
    "every second column": lambda good: np.repeat(good, 2, axis=1)[:, ::2],
    "backwards": lambda good: good[::-1, ::-1].copy()[::-1, ::-1],
    "big endian": lambda good: good.astype(">f4"),
    "read only": lambda good: np.frombuffer(good.tobytes(), good.dtype).reshape(good.shape),
    "masked": lambda good: np.ma.masked_where(good == 0, good),
    "NaN for nothing": lambda good: np.where(good > 0, good, np.nan),
    "negative for nothing": lambda good: np.where(good > 0, good, -1),
    "list": lambda good: good.tolist(),
}


@pytest.mark.parametrize("kind", USABLE)
def test_every_layout_of_a_good_image_tracks_alike(kind: str) -> None:
    track, good = tracker(), frames()
    track.reset(first_pose())
    expected = track.track(good[1].depth)
    track.reset(first_pose())
    given_ = USABLE[kind](good[1].depth)
    copy = np.array(given_)
    result = track.track(given_)
    assert result.state is TrackState.TRACKING
    tolerance = 2e-3 if kind == "half precision" else 0.0
    np.testing.assert_allclose(result.keypoints, expected.keypoints, atol=tolerance)
    np.testing.assert_array_equal(np.array(given_), copy)


@st.composite
def damaged_images(draw: st.DrawFn) -> np.ndarray:
    """A good image with rectangles of wrong values, of any float type and layout."""
    image = frames()[draw(st.integers(0, 3))].depth.astype(
        draw(st.sampled_from([np.float16, np.float32, np.float64]))
    )
    for _ in range(draw(st.integers(0, 4))):
        top, left = draw(st.integers(0, 110)), draw(st.integers(0, 150))
        rows, columns = draw(st.integers(1, 120)), draw(st.integers(1, 160))
        value = draw(st.floats(width=16) | st.sampled_from([0.0, 0.3, 0.45, np.nan, -np.inf]))
        image[top : top + rows, left : left + columns] = value
    if draw(st.booleans()):
        image = np.asfortranarray(image)
    if draw(st.booleans()):
        image = image[::-1]
    return image


@settings(max_examples=25, deadline=None)
@given(st.lists(damaged_images(), min_size=1, max_size=3))
def test_no_image_raises_or_gives_nan(images: list[np.ndarray]) -> None:
    track, good = tracker(), frames()
    track.reset(first_pose())
    track.track(good[0].depth)
    for image in images:
        with np.errstate(all="ignore"):
            result = track.track(image)
        check_finite(result)
        assert (result.problem is None) == (result.state in FOUND)
        assert np.isnan(result.depth_error) or 0.0 <= result.depth_error <= 0.04 + 1e-6
    # Whatever was seen, a reset forgets it.
    track.reset(first_pose())
    assert error_mm(track.track(good[0].depth), good[0]) < 10


NO_ARRAYS = (
    st.binary(max_size=40)
    | st.lists(st.floats(), max_size=5)
    | st.text(max_size=5)
    | st.dictionaries(st.text(max_size=2), st.integers(), max_size=2)
    | st.floats()
    | st.sampled_from([print, object(), Ellipsis, np.datetime64("2020-01-01"), CAMERA])
)


@settings(max_examples=30, deadline=None)
@given(NO_ARRAYS)
def test_what_is_not_even_an_array_is_told(anything: Any) -> None:
    track = tracker()
    track.reset(first_pose())
    result = track.track(anything)
    assert result.state is TrackState.LOST and result.problem
    check_finite(result)


@pytest.mark.parametrize("value", [MAX_DEPTH * 2, -1e30, 65535.0])
def test_a_good_image_with_impossible_pixels_still_tracks(value: float) -> None:
    track, good = tracker(), frames()
    track.reset(first_pose())
    image = np.where(good[0].depth > 0, good[0].depth, np.float32(value))
    result = track.track(image)
    assert result.state is TrackState.TRACKING and error_mm(result, good[0]) < 10


def test_without_a_first_pose_there_is_no_hand() -> None:
    track = tracker()
    track.reset()
    for depth in (frames()[0].depth, None, np.zeros(CAMERA.shape, np.float32)):
        result = track.track(depth)
        assert result.state is TrackState.NO_HAND and result.problem
        assert result.pose.shape == (NQ,) and np.isnan(result.pose).all()
        assert result.keypoints.shape == (21, 3) and np.isnan(result.keypoints).all()
        assert np.isnan(result.depth_error)
    result = track.track(frames()[0].depth)
    assert result.problem is not None and "first pose" in result.problem


@pytest.mark.parametrize(
    "pose",
    [
        np.zeros(27), np.full(28, np.nan), np.zeros(28), "open hand", [1.0] * 27 + [np.inf],
        np.zeros((1, 28)), {"tx": 1}, [[1.0], [2.0, 3.0]],
    ],
    ids=["27", "nan", "no quaternion", "text", "infinite", "matrix", "dict", "ragged"],
)  # fmt: skip
def test_reset_refuses_what_is_no_pose_and_keeps_tracking(pose: Any) -> None:
    track, good = tracker(), frames()
    track.reset(first_pose())
    track.track(good[0].depth)
    with pytest.raises(InputError, match=r"pose"):
        track.reset(pose)
    track.reset(first_pose() * np.r_[np.ones(3), np.full(4, 1.5), np.ones(21)])
    assert track.track(good[0].depth).state is TrackState.TRACKING


@pytest.mark.parametrize(
    ("change", "message"),
    [({"side": "both"}, "side"), ({"tracker": "magic"}, "model_based")],
)
def test_the_constructor_says_what_is_wrong(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        HandTracker(CAMERA, device="cpu", **change)
