"""Registration of motions in time."""

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.grasp.warping import log_increments, registered, resampled, unwarped, warp_of


def motion(times):
    return np.stack([np.sin(2.0 * times), times**2, np.cos(times)], axis=1)


def test_a_motion_registers_to_itself_frame_by_frame():
    reference = motion(np.linspace(0.0, 1.0, 40))
    (warp,) = registered(reference, [reference])
    np.testing.assert_allclose(warp, np.arange(40), atol=1e-6)


def test_a_motion_that_speeds_up_is_brought_to_the_time_of_the_reference():
    reference = motion(np.linspace(0.0, 1.0, 50))
    times = np.linspace(0.0, 1.0, 70) ** 1.5
    (warp,) = registered(reference, [motion(times)])
    assert warp[0] == 0.0 and np.isclose(warp[-1], 69.0)
    assert (np.diff(warp) > 0.0).all()
    plain = resampled(motion(times), np.linspace(0.0, 69.0, 50))
    assert np.abs(resampled(motion(times), warp) - reference).max() < 0.05
    assert np.abs(plain - reference).max() > 0.1


def test_motions_registered_together_and_alone_are_the_same():
    reference = motion(np.linspace(0.0, 1.0, 30))
    others = [motion(np.linspace(0.0, 1.0, n) ** p) for n, p in ((25, 1.3), (45, 0.8))]
    together = registered(reference, others)
    for other, warp in zip(others, together, strict=True):
        # Costs of steps aside are relative to each motion's distances; padding alters them little.
        np.testing.assert_allclose(registered(reference, [other])[0], warp, atol=1.0)


def test_log_increments_and_warps_are_inverse_and_any_numbers_give_a_rising_warp():
    warp = np.cumsum(np.random.default_rng(0).uniform(0.1, 2.0, 20))
    warp -= warp[0]
    np.testing.assert_allclose(warp_of(log_increments(warp)), warp)
    wild = np.random.default_rng(1).normal(0.0, 2.0, (5, 30))
    assert (np.diff(warp_of(wild), axis=1) > 0.0).all()


def test_warping_back_gives_the_motion_in_its_own_time():
    warp = np.concatenate([np.linspace(0.0, 10.0, 11), np.linspace(13.0, 40.0, 10)])
    values = warp[:, None] * np.array([1.0, -2.0])  # in its own time: even speed
    out = unwarped(values[None], warp[None], 41)[0]
    np.testing.assert_allclose(out[:, 0], np.arange(41.0), atol=1e-9)
    np.testing.assert_allclose(out[:, 1], -2.0 * np.arange(41.0), atol=1e-9)


def test_motions_with_other_features_are_refused():
    with pytest.raises(InputError, match="shape"):
        registered(np.zeros((5, 3)), [np.zeros((5, 2))])
