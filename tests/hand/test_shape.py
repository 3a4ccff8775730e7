"""Shape coordinates: files, ranges and what they do to the hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtrack.errors import DamagedFileError, HandtrackError, InputError, MissingFileError
from handtrack.hand.kinematics import keypoints, skin
from handtrack.hand.shape import HandShape
from oracles.scenes import hand_model

in_tmp = settings(
    deadline=None,
    max_examples=25,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
coordinates = st.lists(st.floats(-5, 5), max_size=8).map(np.array)


@in_tmp
@given(alpha=coordinates, beta=coordinates, scale=st.floats(0.2, 5.0))
def test_a_saved_shape_loads_as_it_was(
    tmp_path: Path, alpha: np.ndarray, beta: np.ndarray, scale: float
) -> None:
    path = tmp_path / "me.npz"
    HandShape(alpha=alpha, beta=beta, scale=scale).save(path)
    loaded = HandShape.load(path)
    np.testing.assert_array_equal(loaded.alpha, alpha)
    np.testing.assert_array_equal(loaded.beta, beta)
    assert loaded.scale == scale


def test_a_shape_is_saved_where_it_was_told(tmp_path: Path) -> None:
    path = tmp_path / "me"
    HandShape(alpha=np.array([1.0])).save(path)
    np.testing.assert_array_equal(HandShape.load(path).alpha, [1.0])


def test_what_a_fit_tells_is_saved_with_the_shape(tmp_path: Path) -> None:
    path = tmp_path / "me.npz"
    told = HandShape(
        alpha=np.array([1.0, 2.0]), beta=np.array([3.0]), scale=1.1,
        alpha_std=np.array([0.1, 0.2]), beta_std=np.array([0.3]), scale_std=0.01,
        problem="only fists",
    )  # fmt: skip
    told.save(path)
    loaded = HandShape.load(path)
    np.testing.assert_array_equal(loaded.alpha_std, told.alpha_std)
    np.testing.assert_array_equal(loaded.beta_std, told.beta_std)
    assert (loaded.scale_std, loaded.problem) == (0.01, "only fists")


def test_a_shape_without_uncertainty_is_read_as_before(tmp_path: Path) -> None:
    path = tmp_path / "old.npz"
    np.savez(path, format_version=1, alpha=np.ones(2), beta=np.zeros(1), scale=1.0)
    loaded = HandShape.load(path)
    assert loaded.alpha_std is loaded.beta_std is loaded.scale_std is loaded.problem is None


@pytest.mark.parametrize(
    "values",
    [
        {"alpha_std": np.zeros(1)},
        {"alpha": np.zeros(2), "alpha_std": [0.1, -0.1]},
        {"beta": np.zeros(1), "beta_std": [np.nan]},
        {"scale_std": -0.1},
        {"alpha": np.zeros((2, 2))},
        {"beta": np.float64(1.0)},
        {"alpha": [np.nan]},
        {"beta": [np.inf]},
        {"scale": 0.0},
        {"scale": -1.0},
        {"scale": 100.0},
        {"scale": np.nan},
    ],
)
def test_an_impossible_shape_is_refused(values: dict) -> None:
    with pytest.raises(InputError, match=r"HandShape\.(alpha|beta|scale)"):
        HandShape(**values)


def test_more_coordinates_than_the_model_has_are_refused() -> None:
    model = hand_model()
    with pytest.raises(InputError, match=f"this model has {model.nalpha}"):
        model.shaped(HandShape(alpha=np.zeros(model.nalpha + 1)))
    with pytest.raises(InputError, match=f"this model has {model.nbeta}"):
        model.shaped(HandShape(beta=np.zeros(model.nbeta + 1)))


def test_missing_coordinates_are_zeros(rng: np.random.Generator) -> None:
    model = hand_model()
    alpha, beta = np.zeros(model.nalpha), np.zeros(model.nbeta)
    alpha[:2], beta[:1] = [1.0, -0.5], [0.7]
    short = model.shaped(HandShape(alpha=alpha[:2], beta=beta[:1]))
    full = model.shaped(HandShape(alpha=alpha, beta=beta))
    np.testing.assert_array_equal(short.local_vertices, full.local_vertices)
    np.testing.assert_array_equal(short.bone_origins, full.bone_origins)


def test_the_overall_scale_scales_everything() -> None:
    model = hand_model()
    shape = model.sample_shape(np.random.default_rng(1))
    larger = HandShape(alpha=shape.alpha, beta=shape.beta, scale=1.25)
    pose = np.zeros(28)
    pose[3], pose[7:] = 1.0, 0.2
    small, large = model.shaped(shape), model.shaped(larger)
    np.testing.assert_allclose(skin(large, pose), 1.25 * skin(small, pose), atol=1e-12)
    np.testing.assert_allclose(keypoints(large, pose), 1.25 * keypoints(small, pose), atol=1e-12)
    assert large.cut_x == pytest.approx(1.25 * small.cut_x)


def test_the_same_seed_draws_the_same_shape() -> None:
    model = hand_model()
    a, b, c = (model.sample_shape(np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(a.alpha, b.alpha)
    np.testing.assert_array_equal(a.beta, b.beta)
    assert not np.array_equal(a.alpha, c.alpha)
    none = model.sample_shape(np.random.default_rng(3), deviation=0.0)
    assert not none.alpha.any() and not none.beta.any()


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nobody\.npz") as caught:
        HandShape.load(tmp_path / "nobody.npz")
    assert isinstance(caught.value, FileNotFoundError) and isinstance(caught.value, HandtrackError)


def write_shape(path: Path, **changed: object) -> Path:
    values: dict = {"format_version": 1, "alpha": np.zeros(2), "beta": np.zeros(2), "scale": 1.0}
    values.update(changed)
    np.savez(path, **{k: v for k, v in values.items() if v is not None})
    return path


@pytest.mark.parametrize(
    "changed",
    [
        {"alpha": None},
        {"scale": None},
        {"alpha": np.array([np.nan])},
        {"alpha": np.array(["a"])},
        {"alpha": np.array([{}], object)},
        {"beta": np.zeros((2, 2))},
        {"scale": 1e9},
        {"scale": np.ones(3)},
        {"format_version": 99},
    ],
    ids=str,
)
def test_a_file_that_holds_no_shape_is_told(tmp_path: Path, changed: dict) -> None:
    with pytest.raises(DamagedFileError, match=r"shape\.npz"):
        HandShape.load(write_shape(tmp_path / "shape.npz", **changed))


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x93NUMPY"])
def test_a_file_of_another_kind_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "shape.npz"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError):
        HandShape.load(path)


def test_a_bare_array_is_told(tmp_path: Path) -> None:
    path = tmp_path / "shape.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DamagedFileError):
        HandShape.load(path)


@in_tmp
@given(data=st.data())
def test_a_damaged_file_loads_or_is_told(tmp_path: Path, data: st.DataObject) -> None:
    path = write_shape(tmp_path / "shape.npz")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        shape = HandShape.load(path)
    except DamagedFileError:
        return
    assert np.isfinite(shape.alpha).all() and np.isfinite(shape.scale)
