"""The Gaussian prior: what PCA keeps, what a file keeps, and the one that is shipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.hand.skeleton import ANGLES
from handtrack.priors.gaussian import GaussianPrior
from handtrack.synthesis.motion import Motion
from oracles.scenes import hand_model


def correlated(count: int, rng: np.random.Generator) -> np.ndarray:
    """Angles in which three synergies explain nearly everything."""
    synergies = np.linalg.qr(rng.normal(size=(21, 3)))[0].T
    weights = rng.normal(size=(count, 3)) * [0.9, 0.5, 0.3]
    return 0.2 + weights @ synergies + 0.02 * rng.normal(size=(count, 21))


def test_synergies_are_found(rng: np.random.Generator) -> None:
    angles = correlated(4000, rng)
    prior = GaussianPrior.learn(angles, explained=0.95)
    assert prior.axes.shape == (21, 3)
    np.testing.assert_allclose(np.sqrt(prior.variances), [0.9, 0.5, 0.3], rtol=0.06)
    assert np.sqrt(prior.residual_variance) == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(prior.mean, angles.mean(0))
    np.testing.assert_allclose(prior.axes.T @ prior.axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(prior.covariance, np.cov(angles.T), atol=2e-3)
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(21), atol=1e-9)


def test_samples_have_the_prior_s_mean_and_covariance(rng: np.random.Generator) -> None:
    prior = GaussianPrior.learn(correlated(500, rng))
    samples = prior.sample(rng, 20000)
    np.testing.assert_allclose(samples.mean(0), prior.mean, atol=0.03)
    np.testing.assert_allclose(np.cov(samples.T), prior.covariance, atol=0.03)


def test_malformed_samples_are_refused() -> None:
    for angles in (np.zeros((21, 21)), np.zeros((50, 20)), np.zeros(21)):
        with pytest.raises(InputError, match="expected"):
            GaussianPrior.learn(angles)


def test_a_file_keeps_the_prior(tmp_path: Path, rng: np.random.Generator) -> None:
    prior = GaussianPrior.learn(correlated(100, rng))
    prior.save(tmp_path / "p.npz", source="a test", licence="CC0-1.0")
    again = GaussianPrior.load(tmp_path / "p.npz")
    np.testing.assert_array_equal(again.covariance, prior.covariance)
    with pytest.raises(MissingFileError, match=r"none\.npz"):
        GaussianPrior.load(tmp_path / "none.npz")
    (tmp_path / "p.npz").write_bytes((tmp_path / "p.npz").read_bytes()[:300])
    with pytest.raises(DamagedFileError, match=r"p\.npz"):
        GaussianPrior.load(tmp_path / "p.npz")


def test_the_shipped_prior_knows_how_hands_move() -> None:
    prior = GaussianPrior.load()
    low, high = hand_model().limits.T
    assert ((prior.mean > low) & (prior.mean < high)).all()
    spread = np.degrees(np.sqrt(np.diag(prior.covariance)))
    assert (spread > 3).all() and (spread < 60).all()
    # Fingers bend together: neighbours' knuckles go hand in hand, and so do joints of a finger.
    correlation = prior.covariance / np.outer(spread, spread) * np.degrees(1) ** 2
    first, second = ANGLES.index("middle_mcp_flexion"), ANGLES.index("ring_mcp_flexion")
    assert correlation[first, second] > 0.7
    # It suits motion of somebody it was not learnt from better than no knowledge does.
    motion = Motion.load("recorded_hand_motion").poses[:, 6:].astype(float)
    off = motion - prior.mean
    unexplained = off - (off @ prior.axes) @ prior.axes.T
    assert prior.axes.shape[1] <= 14
    assert (unexplained**2).sum() < 0.15 * (off**2).sum()
    with np.load(artifact_path("pose_prior.npz"), allow_pickle=False) as data:
        assert str(data["source"]) and str(data["licence"])
