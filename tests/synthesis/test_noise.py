"""Sensor noise: its statistics against the formulas of the papers, and what must never happen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.synthesis.noise import (
    CODED_LIGHT,
    NONE,
    PRESETS,
    STRUCTURED_LIGHT,
    TIME_OF_FLIGHT,
    SensorNoise,
    noise_preset,
)
from handtrack.synthesis.surface import edge_pixels, surface_slant

CAMERA = Camera(width=160, height=120, fx=240.0, fy=240.0, cx=79.5, cy=59.5)


def plane(distance: float, tilt_degrees: float, camera: Camera = CAMERA) -> np.ndarray:
    """Depth of a plane through (0, 0, distance), turned about the vertical axis."""
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    z = distance / (1.0 - np.tan(np.radians(tilt_degrees)) * u)
    return np.broadcast_to(z, camera.shape).astype(np.float32)


def two_walls(near: float, far: float) -> np.ndarray:
    """The left half of the image near, the right half far (0: empty)."""
    depth = np.full(CAMERA.shape, near, np.float32)
    depth[:, CAMERA.width // 2 :] = far
    return depth


def quadratic_residual(depth: np.ndarray, size: int) -> float:
    """Median residual [m] of a quadratic fitted to every full window of the image."""
    half = size // 2
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[-half : half + 1, -half : half + 1])
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    project = np.eye(size * size) - basis @ np.linalg.pinv(basis)
    windows = np.lib.stride_tricks.sliding_window_view(depth.astype(float), (size, size))
    windows = windows.reshape(-1, size * size)
    windows = windows[(windows > 0).all(axis=1) & (np.ptp(windows, axis=1) < 0.02)]
    return float(np.median(np.sqrt(((windows @ project) ** 2).sum(axis=1) / (size * size - 6))))


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 75.0])
def test_slant_of_a_plane_is_its_tilt(tilt: float) -> None:
    slant = surface_slant(plane(0.6, tilt), CAMERA)
    centre = slant[:, 20:140]
    # float32 depth: the slope of a frontal plane is known to about 1e-4.
    assert np.degrees(np.abs(centre - np.radians(tilt))).max() < 0.5


@pytest.mark.parametrize(
    ("source", "z", "theta", "expected_mm"),
    [
        # Nguyen 2012: 1.2 + 1.9 (z - 0.4)^2 + 0.1 / sqrt(z) * (theta / (pi/2 - theta))^2 [mm]
        (STRUCTURED_LIGHT, 0.4, 0.0, 1.2),
        (STRUCTURED_LIGHT, 1.4, 0.0, 3.1),
        (STRUCTURED_LIGHT, 0.64, math.pi / 4, 1.2 + 1.9 * 0.0576 + 0.125),
        # Fankhauser 2015 in the same form: 1.5 - 0.5 z + 0.3 z^2 + 0.1 z^1.5 (...)^2 [mm]
        (SensorNoise(axial_floor=0.0015 - 0.0005**2 / 4 / 0.0003, axial_growth=0.0003,
                     axial_reference=5 / 6, slant_gain=0.0001, slant_power=1.5),
         2.0, math.pi / 3, 1.5 - 1.0 + 1.2 + 0.1 * 2.0**1.5 * 4.0),
    ],
)  # fmt: skip
def test_deviation_follows_the_papers(
    source: SensorNoise, z: float, theta: float, expected_mm: float
) -> None:
    assert 1e3 * source.axial_deviation(z, theta) == pytest.approx(expected_mm, rel=1e-9)


@pytest.mark.parametrize("preset", [STRUCTURED_LIGHT, TIME_OF_FLIGHT, CODED_LIGHT])
@pytest.mark.parametrize(("distance", "tilt"), [(0.4, 0.0), (0.8, 0.0), (0.5, 45.0), (0.5, 60.0)])
def test_measured_deviation_on_a_tilted_plane_matches_the_formula(
    preset: SensorNoise, distance: float, tilt: float, rng: np.random.Generator
) -> None:
    clean = plane(distance, tilt)
    noise = replace(preset, depth_step=0.0, inverse_depth_step=0.0, dropout=0.0)
    images = noise.apply(np.stack([clean] * 80), CAMERA, rng)[:, 10:-10, 60:100]
    error = images.astype(np.float64) - clean[10:-10, 60:100]
    expected = preset.axial_deviation(clean[10:-10, 60:100], np.radians(tilt))
    assert (images > 0).mean() > 0.99
    measured = np.sqrt(np.mean((error / expected)[images > 0] ** 2))
    assert measured == pytest.approx(1.0, rel=0.1)
    assert abs(np.mean((error / expected)[images > 0])) < 0.1


def test_grain_makes_neighbours_alike_and_keeps_the_deviation(rng: np.random.Generator) -> None:
    clean = plane(0.5, 0.0)
    grained = SensorNoise(axial_floor=0.002, axial_grain=2.0 / CAMERA.fx)
    error = grained.apply(np.stack([clean] * 30), CAMERA, rng) - clean
    assert error.std() == pytest.approx(0.002, rel=0.05)
    neighbours = np.mean(error[:, :, 1:] * error[:, :, :-1]) / error.var()
    # Autocorrelation of white noise smoothed by a Gaussian: exp(-d^2 / (4 sigma^2)).
    assert neighbours == pytest.approx(math.exp(-1 / 16), abs=0.03)


def test_disparity_steps_grow_with_the_square_of_the_distance(rng: np.random.Generator) -> None:
    noise = SensorNoise(inverse_depth_step=0.125 / (585 * 0.075))
    for distance in (0.5, 1.5):
        ramp = np.linspace(distance, distance + 0.05, CAMERA.width, dtype=np.float32)
        out = noise.apply(np.broadcast_to(ramp, CAMERA.shape), CAMERA, rng)
        step = np.diff(np.unique(out))
        middle = distance + 0.025
        assert np.median(step) == pytest.approx(middle**2 * noise.inverse_depth_step, rel=0.05)
        assert np.abs(out - ramp).max() <= 0.51 * step.max()


def test_fixed_steps_give_whole_millimetres(rng: np.random.Generator) -> None:
    out = SensorNoise(depth_step=0.001).apply(plane(0.5, 30.0), CAMERA, rng).astype(np.float64)
    assert np.abs(out * 1e3 - np.rint(out * 1e3)).max() < 1e-4
    assert np.abs(out - plane(0.5, 30.0)).max() <= 0.0005 + 1e-6


def test_flying_pixels_lie_between_both_surfaces_at_the_edge(rng: np.random.Generator) -> None:
    clean = two_walls(0.4, 0.7)
    out = SensorNoise(flying=0.5).apply(clean, CAMERA, rng)
    changed = out != clean
    assert set(np.nonzero(changed)[1]) == {CAMERA.width // 2 - 1}
    assert changed.sum() / CAMERA.height == pytest.approx(0.5, abs=0.15)
    assert ((out[changed] >= 0.4) & (out[changed] <= 0.7)).all()
    assert out[changed].std() > 0.05


def test_flying_pixels_with_nothing_behind_lie_within_the_given_distance(
    rng: np.random.Generator,
) -> None:
    clean = two_walls(0.4, 0.0)
    out = SensorNoise(flying=1.0, flying_depth=0.2).apply(clean, CAMERA, rng)
    edge = out[:, CAMERA.width // 2 - 1]
    assert ((edge >= 0.4) & (edge < 0.6)).all() and edge.max() > 0.45
    assert not out[:, CAMERA.width // 2 :].any()


def test_edges_and_steep_surfaces_lose_pixels_at_the_given_rates(rng: np.random.Generator) -> None:
    clean = np.stack([two_walls(0.4, 0.7)] * 20)
    out = SensorNoise(edge_missing=0.3).apply(clean, CAMERA, rng)
    lost = out == 0
    assert lost[edge_pixels(clean, CAMERA)].mean() == pytest.approx(0.3, abs=0.05)
    assert not lost[~edge_pixels(clean, CAMERA)].any()

    steep = SensorNoise(
        slant_missing_start=math.radians(60.0), slant_missing_full=math.radians(80.0)
    )
    for tilt, share in ((50.0, 0.0), (65.0, 0.25), (70.0, 0.5), (75.0, 0.75)):
        out = steep.apply(plane(0.5, tilt), CAMERA, rng)[:, 70:90]
        assert (out == 0).mean() == pytest.approx(share, abs=0.05)

    out = SensorNoise(dropout=0.02).apply(np.stack([plane(0.5, 0.0)] * 20), CAMERA, rng)
    assert (out == 0).mean() == pytest.approx(0.02, rel=0.1)


def test_projector_casts_a_shadow_of_the_disparity_difference(rng: np.random.Generator) -> None:
    clean = np.full(CAMERA.shape, 0.8, np.float32)
    clean[40:80, 60:100] = 0.4
    # 240 px * 0.05 m * (1 / 0.4 - 1 / 0.8) = 15 px; the last one is grazed
    right = SensorNoise(shadow_baseline=0.05).apply(clean, CAMERA, rng)
    left = SensorNoise(shadow_baseline=-0.05).apply(clean, CAMERA, rng)
    assert np.flatnonzero(right[60] == 0).tolist() == list(range(46, 60))
    assert np.flatnonzero(left[60] == 0).tolist() == list(range(100, 114))
    assert (right[20] > 0).all() and (left[20] > 0).all()


def test_silhouettes_move_both_ways_and_never_far(rng: np.random.Generator) -> None:
    clean = two_walls(0.4, 0.0)
    half = CAMERA.width // 2
    noise = SensorNoise(edge_jitter=1.0 / CAMERA.fx)
    out = noise.apply(np.stack([clean] * 40), CAMERA, rng) > 0
    place = out.sum(axis=2) - half
    assert abs(place.mean()) < 0.1
    # A pixel that jumps over the edge counts once: the deviation of the count is below one pixel.
    assert 0.5 < place.std() < 1.2
    assert not out[:, :, half + 6 :].any() and out[:, :, : half - 6].all()

    noise = SensorNoise(edge_growth=1.0 / CAMERA.fx)
    width = (noise.apply(np.stack([clean] * 200), CAMERA, rng) > 0).sum(axis=(1, 2))
    width = width / CAMERA.height - half
    assert abs(width.mean()) < 0.2
    assert width.std() == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_leave_the_empty_background_empty(name: str, rng: np.random.Generator) -> None:
    clean = np.zeros((3, *CAMERA.shape), np.float32)
    clean[:, 40:80, 60:100] = 0.5
    out = noise_preset(name).apply(clean, CAMERA, rng)
    far = np.ones(CAMERA.shape, bool)
    far[32:88, 52:108] = False
    assert not out[:, far].any()
    assert out.dtype == np.float32 and np.isfinite(out).all() and (out >= 0).all()
    inner = out[:, 46:74, 66:94]
    assert (inner > 0).mean() > 0.98
    assert not noise_preset(name).apply(np.zeros(CAMERA.shape), CAMERA, rng).any()


@pytest.mark.parametrize(
    ("preset", "distance", "size", "low_mm", "high_mm"),
    [
        # What is left on hands and bodies of NYU, SR305 and MSRA recordings at these distances.
        (STRUCTURED_LIGHT, 0.72, 5, 0.4, 0.75), (STRUCTURED_LIGHT, 0.72, 11, 0.6, 1.0),
        (CODED_LIGHT, 0.6, 5, 0.03, 0.08), (CODED_LIGHT, 0.6, 11, 0.06, 0.2),
        (TIME_OF_FLIGHT, 0.3, 5, 0.55, 0.9), (TIME_OF_FLIGHT, 0.3, 11, 0.8, 1.3),
    ],
)  # fmt: skip
def test_presets_are_as_noisy_as_recordings(
    preset: SensorNoise, distance: float, size: int, low_mm: float, high_mm: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    fx = {STRUCTURED_LIGHT: 588.0, CODED_LIGHT: 475.0, TIME_OF_FLIGHT: 241.4}[preset]
    camera = Camera(width=160, height=120, fx=fx, fy=fx, cx=79.5, cy=59.5)
    image = preset.apply(plane(distance, 20.0, camera), camera, rng)
    assert low_mm < 1e3 * quadratic_residual(image, size) < high_mm


def test_no_noise_changes_nothing(rng: np.random.Generator) -> None:
    clean = two_walls(0.4, 0.7)
    state = rng.bit_generator.state
    out = NONE.apply(clean, CAMERA, rng)
    assert (out == clean).all() and out is not clean
    assert rng.bit_generator.state == state


@pytest.mark.parametrize("name", list(PRESETS))
def test_same_seed_same_noise_and_a_batch_is_its_images(name: str) -> None:
    clean = np.stack([two_walls(0.4, 0.7), plane(0.5, 40.0), two_walls(0.5, 0.0)])
    before = clean.copy()
    noise = noise_preset(name)
    batch = noise.apply(clean, CAMERA, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    singles = np.stack([noise.apply(image, CAMERA, rng) for image in clean])
    assert (batch == singles).all()
    assert (clean == before).all()
    if name != "none":
        other = noise.apply(clean, CAMERA, np.random.default_rng(4))
        assert (batch != other).mean() > 0.2


@pytest.mark.filterwarnings("error")
@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(list(PRESETS)),
    st.integers(0, 2**32 - 1),
    st.lists(
        st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e-3, 0.2, 0.5, 3.0, 1e9]),
        min_size=1,
        max_size=6,
    ),
)
def test_any_image_gives_finite_depth(name: str, seed: int, values: list[float]) -> None:
    camera = Camera(width=24, height=16, fx=30.0, fy=30.0, cx=12.0, cy=8.0)
    rng = np.random.default_rng(seed)
    depth = rng.choice(np.array(values, np.float64), camera.shape)
    out = noise_preset(name).apply(depth, camera, rng)
    assert out.dtype == np.float32 and out.shape == camera.shape
    assert np.isfinite(out).all() and (out >= 0).all()


def test_wrong_size_and_wrong_settings_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="does not fit the camera"):
        NONE.apply(np.zeros((10, 10)), CAMERA, rng)
    with pytest.raises(InputError, match="axial_floor"):
        SensorNoise(axial_floor=-1.0)
    with pytest.raises(InputError, match="probability"):
        SensorNoise(flying=1.5)
    with pytest.raises(InputError, match="slant_missing_start"):
        SensorNoise(slant_missing_start=1.2, slant_missing_full=1.0)
    with pytest.raises(InputError, match="structured_light"):
        noise_preset("kinect")
    assert noise_preset("structured-light") == STRUCTURED_LIGHT
