"""What is told of a shape's certainty, from equations and poses."""

from __future__ import annotations

import numpy as np

from handtrack.fitting.shape_certainty import shape_certainty
from handtrack.fitting.shape_unknowns import ShapeUnknowns
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.skeleton import ANGLES
from oracles.scenes import hand_model

KNEW = FitInformation(hessian=np.eye(27), unexplained=0.05, area=0.01, spacing=0.004)


def certainty(poses: np.ndarray, amount: float):
    unknowns = ShapeUnknowns(hand_model())
    told = np.tile(amount * np.eye(unknowns.count), (len(poses), 1, 1))
    return shape_certainty(
        unknowns, np.zeros(unknowns.count), told, poses, [KNEW] * len(poses), scale_deviation=0.05
    )


def test_images_that_tell_nothing_leave_every_finger_open() -> None:
    found = certainty(np.zeros((2, 28)), 0.0)
    np.testing.assert_allclose(found.lengths, found.prior_lengths)
    assert len(found.open_fingers) == 5 and "any finger" in str(found.problem)


def test_fists_alone_are_warned_of_however_much_they_tell() -> None:
    fist = np.zeros(28)
    fist[7:] = [1.5 if name.endswith("pip_flexion") else 0.0 for name in ANGLES]
    found = certainty(np.stack([fist, fist]), 1e6)
    assert found.open_fingers == ["index", "middle", "ring", "little"]
    assert "index, middle" in str(found.problem)
    # One image with the fingers stretched is enough.
    assert certainty(np.stack([fist, np.zeros(28)]), 1e6).problem is None


def test_deviations_shrink_as_the_images_tell_more() -> None:
    some, more = certainty(np.zeros((1, 28)), 10.0), certainty(np.zeros((4, 28)), 10.0)
    weight = KNEW.point_precision / 1e4
    np.testing.assert_allclose(some.deviations[1], (10.0 * weight + 1.0) ** -0.5)
    assert (more.deviations < some.deviations).all()
