"""Before and after: the mean hand and the fitted one over the images that it was fitted to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.model import ShapedHand
from handtrack.tracking.shape_calibration import Calibration
from handtrack.viewer.pictures import INK, OverlayPainter, PictureStyle, contact_sheet

_STYLE = PictureStyle(panel=(300, 300), zoom=0.26, side_by_side=False, mesh_opacity=0.6)


def shape_page(fit: Calibration, camera: Camera, mean: ShapedHand) -> NDArray[np.uint8]:
    """Draw the page: one row per image, before at the left, after at the right.

    Args:
        fit: The fitted shape.
        camera: Camera of the images.
        mean: The mean hand of the same side.

    Returns:
        Picture, shape (height, width, 3), channels B G R.
    """
    columns = [
        (told, OverlayPainter(hand, camera, style=_STYLE), poses, errors)
        for told, hand, poses, errors in (
            ("mean hand", mean, fit.mean_poses, fit.mean_errors),
            ("fitted", fit.hand, fit.poses, fit.errors),
        )
    ]
    pictures = []
    for row, depth in enumerate(fit.depths):
        left_out = "" if fit.used[row] else ", left out"
        for told, painter, poses, errors in columns:
            painter.cut()
            pictures.append(painter.paint(
                depth, poses[row],
                lines=[
                    (f"image {fit.images[row]}, {told}{left_out}", INK),
                    (f"depth error {1e3 * errors[row]:.1f} mm", INK),
                ],
            ))  # fmt: skip
    return contact_sheet(pictures, 4 if len(fit.depths) > 3 else 2)
