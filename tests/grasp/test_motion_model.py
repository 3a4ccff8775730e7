"""Models of closing motions."""

import numpy as np
import pytest

from grasp.recordings import COUNTS, recording
from handtrack.errors import InputError
from handtrack.grasp.motion_model import GraspMotionModel, MotionModelConfig, learn_grip
from handtrack.transforms import pose_difference


def recordings(count=14):
    rng = np.random.default_rng(5)
    return [
        recording(
            trial=k, seed=k, size=rng.uniform(0.0, 0.4),
            counts={**COUNTS, "closing": int(rng.integers(18, 40))},
        )
        for k in range(count)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def model():
    return learn_grip("tripod", recordings(), MotionModelConfig(shape_variance=0.999))


def test_weights_of_an_example_give_that_example_back(model):
    for k, item in enumerate(recordings()):
        weights = model.examples[k : k + 1]
        closing = item.closing_in_grasp_frame
        assert np.isclose(model.durations(weights)[0], (len(closing) - 1) / 120.0, atol=0.02)
        for frame in (0, -1):
            off = pose_difference(model.motions(weights, 25)[0, frame], closing[frame])
            assert np.abs(off[:3]).max() < 0.004 and np.abs(off[3:]).max() < 0.06


def test_sampled_weights_have_the_mean_and_spread_of_the_examples(model):
    drawn = model.sample(np.random.default_rng(0), 4000)
    np.testing.assert_allclose(drawn.mean(0), model.examples.mean(0), atol=0.1)
    np.testing.assert_allclose(drawn.std(0), model.examples.std(0), atol=0.15)


def test_log_density_is_that_of_the_mixture_and_integrates_to_one(model):
    # Importance sampling by a wide normal distribution.
    rng, size = np.random.default_rng(1), model.nweight
    spread = 1.6
    drawn = spread * rng.standard_normal((60000, size))
    proposal = -0.5 * (drawn**2).sum(1) / spread**2 - size * np.log(spread * np.sqrt(2 * np.pi))
    assert np.isclose(np.exp(model.log_density(drawn) - proposal).mean(), 1.0, atol=0.1)


def test_typical_motions_are_denser_than_odd_ones(model):
    typical = model.log_density(model.examples).min()
    assert typical > model.log_density(np.full((1, model.nweight), 6.0))[0]


def test_motions_of_many_weights_at_once_equal_those_of_one_at_a_time(model):
    weights = model.sample(np.random.default_rng(2), 5)
    together = model.motions(weights, 12)
    assert together.shape == (5, 12, 28)
    for k in range(5):
        np.testing.assert_allclose(model.motions(weights[k : k + 1], 12)[0], together[k])


def test_one_motion_runs_at_the_rate_of_the_database(model):
    alpha, gamma = model.examples[0, : model.nshape], model.examples[0, model.nshape :]
    times, poses = model.motion(alpha, gamma)
    assert len(times) == len(poses)
    np.testing.assert_allclose(np.diff(times), 1.0 / 120.0, rtol=0.05)


def test_modes_are_at_right_angles_and_time_runs_forward(model):
    modes = model.time_modes / np.linalg.norm(model.time_modes, axis=1, keepdims=True)
    np.testing.assert_allclose(modes @ modes.T, np.eye(len(modes)), atol=1e-9)
    weights = 3.0 * np.random.default_rng(3).standard_normal((50, model.nweight))
    assert (np.diff(model.warps(weights), axis=1) > 0.0).all()


def test_the_model_that_comes_along_closes_in_every_grip():
    model = GraspMotionModel.load()
    assert len(model.grips) == 10
    for grip in model.grips.values():
        poses = grip.motions(grip.sample(np.random.default_rng(0), 20), 10)
        assert np.isfinite(poses).all()
        assert np.abs(np.linalg.norm(poses[..., 3:7], axis=-1) - 1.0).max() < 1e-9
        # The hand stays behind the object's centre, and its palm some centimetres away.
        assert (poses[:, -1, 0] < 0.02).all()
        reach = np.linalg.norm(poses[:, -1, :3], axis=-1)
        assert (reach > 0.05).all() and (reach < 0.25).all()


def test_too_few_recordings_and_wrong_weights_are_refused(model):
    with pytest.raises(InputError, match="at least 3"):
        learn_grip("tripod", recordings(2))
    with pytest.raises(InputError, match="weights of tripod"):
        model.motions(np.zeros((4, model.nweight + 1)), 10)
    with pytest.raises(InputError, match="no motions of grip"):
        GraspMotionModel(grips={})["tripod"]
