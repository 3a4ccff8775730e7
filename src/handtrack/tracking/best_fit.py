"""The best of a few start poses, fitted to one image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.fitting.fitter import Fitter
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand

Float = NDArray[np.float64]


def fit_best(
    fitter: Fitter,
    hand: ShapedHand,
    depth: NDArray[np.float32],
    starts: Float,
    *,
    centre: ArrayLike | None = None,
) -> tuple[Float, float, FitInformation]:
    """Fit start poses and take the one that explains the depth best.

    Args:
        fitter: With one row per start.
        hand: Its hand.
        depth: Clean depth [m], shape (height, width).
        starts: Start poses, shape (nrow, 28).
        centre: Middle of what is fitted to [m], shape (3,); that of the starts when None.

    Returns:
        Pose, shape (28,), its depth error [m], and what its fit knew.
    """
    # The middle between the starts keeps each of them within the crop.
    middle = keypoints(hand, starts).mean(axis=(0, 1)) if centre is None else centre
    fitter.load_depth(depth)
    fitter.place(middle)
    fitter.set_poses(starts)
    fitter.run()
    errors = fitter.errors
    best = int(np.argmin(errors))
    return unit_poses(fitter)[best], float(errors[best]), fitter.information(best)


def unit_poses(fitter: Fitter) -> Float:
    """Poses of a fitter's rows with unit quaternions, shape (nrow, 28)."""
    poses = fitter.poses.astype(np.float64)
    poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
    return poses
