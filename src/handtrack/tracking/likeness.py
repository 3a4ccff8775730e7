"""How much the depth around a fitted pose looks like a hand in that pose, beyond its error E_d.

A fist laid on an elbow explains it to a centimetre, no worse than the mean hand explains many a
real hand. What tells them apart is relief: creases and gaps between fingers, outlines that end
where the model ends. The rendered hand and the image are compared in a window of fixed metric size.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import quat_to_matrix

CELLS, SPAN = 96, 0.25
"""The window: cells along each side, and its size at the depth of the hand [m]."""

NEAR, FAR = 0.015, 0.02
"""Depth differences of one surface end at the first, of two surfaces begin at the second [m]."""

RIM = 0.008
"""Width of the rim around the outline [m]."""

COARSE, FINE = 0.012, 0.003
"""Relief is depth between these two scales, sigmas of Gaussians [m]."""

FEATURES = (
    "within 5 mm", "within 10 mm", "background seen through", "hidden", "left over",
    "outline", "relief", "relief depth", "relief correlation, fine", "normals", "mean difference",
    "spread of differences", "reach of the fingers", "area", "worst finger",
)  # fmt: skip
"""What is measured, in the order of `HandLikeness.measure`."""

_BIG = 5.0
"""Stands for the depth of what was not measured [m]."""

_FINGERS = tuple(range(1, 21, 4))
"""First keypoint of thumb, index, middle, ring, little finger."""

Float = NDArray[np.float64]


class HandLikeness:
    """Compares fitted poses of one hand with depth images of one camera."""

    def __init__(self, hand: ShapedHand, camera: Camera, *, device: str | None = None) -> None:
        """Allocate.

        Args:
            hand: The person's hand.
            camera: Camera of the depth images.
            device: "cpu", "cuda:N" or None for the best there is.
        """
        self._camera = camera
        window = Camera(width=CELLS, height=CELLS, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
        self._renderer = DepthRenderer(hand, window, device=device, batch=1)
        self.resize(hand)

    def resize(self, hand: ShapedHand) -> None:
        """Go on with another hand of the same side."""
        # Hands of one side share their triangles; only what is posed differs.
        self._hand = self._renderer.hand = hand

    def measure(self, depth: NDArray[np.float32], pose: Float) -> Float:
        """Measure the likeness.

        Args:
            depth: Clean depth [m], shape (height, width).
            pose: Fitted pose, shape (28,).

        Returns:
            `FEATURES`, shape (15,): shares of the rendered cells, correlations, and lengths in
            hundredths of a metre, so that all are about 1. NaN for a pose out of view.
        """
        points = keypoints(self._hand, pose)
        middle = points.mean(axis=0)
        if not middle[2] > 0.05:
            return np.full(len(FEATURES), np.nan)
        window = _window(middle)
        self._renderer.aim(window)
        drawn = self._renderer.render(pose)[0]
        seen, known = _resampled(depth, self._camera, window)
        shown = (drawn > 0) & known
        count = int(shown.sum())
        if count < CELLS:
            return np.full(len(FEATURES), np.nan)
        cell = SPAN / CELLS
        apart = np.where(seen > 0, seen, _BIG) - drawn
        close = shown & (np.abs(apart) < NEAR)
        differences = apart[close]
        coarse, fine = COARSE / cell, FINE / cell

        def relief(image: NDArray, breadth: float) -> NDArray[np.float32]:
            return _relief(image, close, breadth * coarse, fine)[inner]

        inner = cv2.erode(close.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        smooth_drawn, smooth_seen = (_smooth(image, close, 1.2) for image in (drawn, seen))
        relief_seen = relief(seen, 1.0)
        rotation = quat_to_matrix(pose[3:7])
        return np.array([
            (shown & (np.abs(apart) < 0.005)).sum() / count,
            (shown & (np.abs(apart) < 0.010)).sum() / count,
            (shown & (apart > FAR)).sum() / count,
            (shown & (apart < -FAR)).sum() / count,
            _left_over(seen, drawn, window, pose, rotation, middle) / count,
            _outline(drawn, seen, known, window, pose, rotation, cell),
            _correlation(relief(drawn, 1.0), relief_seen),
            1e2 * float(relief_seen.std()) if inner.any() else 0.0,
            _correlation(relief(drawn, 0.5), relief(seen, 0.5)),
            _normals_agree(smooth_drawn, smooth_seen, inner, cell),
            1e2 * float(differences.mean()) if len(differences) else 0.0,
            1e2 * float(differences.std()) if len(differences) else 2.0,
            1e1 * float(np.linalg.norm(points[8::4] - points[0], axis=1).mean()),
            count * cell**2 * 1e2,
            _worst_finger(points, seen, window),
        ])  # fmt: skip


def _window(middle: Float) -> Camera:
    """Camera of the window around a point [m]."""
    focal = CELLS / SPAN * middle[2]
    centre = 0.5 * (CELLS - 1) - focal * middle[:2] / middle[2]
    return Camera(
        width=CELLS, height=CELLS, fx=focal, fy=focal, cx=float(centre[0]), cy=float(centre[1])
    )


def _resampled(
    depth: NDArray[np.float32], camera: Camera, window: Camera
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The image in the cells of the window, 0 = not measured, and which cells the camera sees."""
    cells = np.arange(CELLS)
    u = np.rint((cells - window.cx) / window.fx * camera.fx + camera.cx).astype(int)
    v = np.rint((cells - window.cy) / window.fy * camera.fy + camera.cy).astype(int)
    across, down = (u >= 0) & (u < camera.width), (v >= 0) & (v < camera.height)
    known = down[:, None] & across[None]
    rows, columns = v.clip(0, camera.height - 1), u.clip(0, camera.width - 1)
    return np.where(known, depth[rows[:, None], columns[None]], np.float32(0)), known


def _smooth(image: NDArray, mask: NDArray[np.bool_], sigma: float) -> NDArray[np.float32]:
    """Gaussian mean over the cells of a mask."""
    weight = mask.astype(np.float32)
    total = cv2.GaussianBlur(np.where(mask, image, 0).astype(np.float32), (0, 0), sigma)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)
    return np.asarray(total / share, np.float32)


def _relief(image: NDArray, mask: NDArray[np.bool_], coarse: float, fine: float) -> NDArray:
    """Depth against its surroundings, without noise [m]."""
    return _smooth(image - _smooth(image, mask, coarse), mask, fine)


def _correlation(first: NDArray, second: NDArray) -> float:
    """Pearson's, 0 where too little is seen."""
    if len(first) < 40:
        return 0.0
    first, second = first - first.mean(), second - second.mean()
    scale = np.sqrt((first @ first) * (second @ second))
    return float(first @ second / max(float(scale), 1e-12))


def _normals_agree(drawn: NDArray, seen: NDArray, inner: NDArray[np.bool_], cell: float) -> float:
    """Mean cosine between both surfaces' normals."""
    if not inner.any():
        return 0.0
    normals = []
    for image in (drawn, seen):
        slopes = [
            cv2.Sobel(image, cv2.CV_32F, *axis)[inner] / (8 * cell) for axis in ((1, 0), (0, 1))
        ]
        normals.append(np.stack([*slopes, -np.ones_like(slopes[0])], axis=-1))
    lengths = np.linalg.norm(normals[0], axis=-1) * np.linalg.norm(normals[1], axis=-1)
    return float(((normals[0] * normals[1]).sum(axis=-1) / lengths).mean())


def _behind_wrist(
    image: NDArray, window: Camera, pose: Float, rotation: Float
) -> NDArray[np.bool_]:
    """Cells whose points lie on the forearm's side of the wrist."""
    points = window.points(image.astype(np.float32))
    return (points - pose[:3]) @ rotation[:, 0] < 0.0


def _left_over(
    seen: NDArray, drawn: NDArray, window: Camera, pose: Float, rotation: Float, middle: Float
) -> int:
    """Cells of something as near as the hand that the model leaves unexplained."""
    points = window.points(seen)
    near = (seen > 0) & (np.linalg.norm(points - middle, axis=-1) < 0.11)
    return int((near & (drawn == 0) & ~_behind_wrist(seen, window, pose, rotation)).sum())


def _outline(
    drawn: NDArray, seen: NDArray, known: NDArray[np.bool_], window: Camera, pose: Float,
    rotation: Float, cell: float,
) -> float:  # fmt: skip
    """Share of the rim around the rendered hand beyond which the image steps back."""
    mask = drawn > 0
    radius = max(round(RIM / cell), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    surface = _smooth(drawn, mask, radius)
    rim = (cv2.dilate(mask.astype(np.uint8), disc) > 0) & ~mask & known
    rim &= ~_behind_wrist(surface, window, pose, rotation)
    if not rim.any():
        return 0.0
    return float((np.where(seen > 0, seen, _BIG) - surface > FAR)[rim].mean())


def _worst_finger(points: Float, seen: NDArray, window: Camera) -> float:
    """Smallest share of a finger's length along which something is seen at its depth or before."""
    shares = []
    for first in _FINGERS:
        joints = points[first : first + 4]
        along = np.concatenate([
            joints[k] + np.linspace(0.0, 1.0, 4)[:, None] * (joints[k + 1] - joints[k])
            for k in range(3)
        ])  # fmt: skip
        pixels = np.rint(window.project(along))
        inside = np.isfinite(pixels).all(-1) & ((pixels >= 0) & (pixels < CELLS)).all(-1)
        if not inside.any():
            continue
        u, v = pixels[inside].astype(int).T
        depth = seen[v, u]
        shares.append(float(((depth > 0) & (depth < along[inside, 2] + FAR)).mean()))
    return min(shares) if shares else 0.0
