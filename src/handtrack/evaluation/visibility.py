"""Which true keypoints a camera sees, and which are behind other parts of the hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.renderer import DepthRenderer

FLESH = 0.025
"""Greatest distance of a keypoint behind the skin that the camera sees there [m]. Keypoints lie
inside the flesh, up to 20 mm deep in the palm; a finger in front of another adds its own 15 mm."""

_BATCH = 16


def visible_keypoints(
    hand: ShapedHand, camera: Camera, poses: ArrayLike, *, device: str | None = None
) -> NDArray[np.bool_]:
    """Whether the flesh around each keypoint is in sight.

    A keypoint is hidden when it is out of the image, or when the first surface on its ray lies more
    than `FLESH` before it. What hides it may be the hand itself or its forearm's stub; other things
    are not known here.

    Args:
        hand: The true hand.
        camera: The camera.
        poses: True poses, shape (n, 28).
        device: "cpu", "cuda:N" or None for the best there is.

    Returns:
        Shape (n, 21).
    """
    poses = np.asarray(poses, np.float64).reshape(-1, 28)
    points = keypoints(hand, poses)
    # NaN, a point behind the camera, is not inside.
    pixels = camera.project(points)
    size = np.array([camera.width, camera.height])
    inside = np.asarray(((pixels > -0.5) & (pixels < size - 0.5)).all(-1))
    column, row = np.where(inside[..., None], np.rint(pixels), 0).astype(np.int64).T
    renderer = DepthRenderer(hand, camera, device=device, batch=_BATCH)
    before = np.zeros(inside.shape)
    for first in range(0, len(poses), _BATCH):
        part = slice(first, first + _BATCH)
        images = renderer.render(poses[part])
        frame = np.arange(len(images))[:, None]
        seen = images[frame, row.T[part], column.T[part]]
        depth = points[part, :, 2]
        # Along the ray; a pixel beside a thin finger shows the background, which hides nothing.
        length = np.linalg.norm(points[part], axis=-1)
        before[part] = np.where(seen > 0, (1 - seen / depth) * length, 0.0)
    return inside & (before <= FLESH)
