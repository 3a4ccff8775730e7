"""A sheet of hands sampled from the shape space, shaded with a small z-buffer renderer."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from handtrack.hand.kinematics import skin
from handtrack.hand.model import HandModel, ShapedHand, vertex_normals

Float = NDArray[np.float64]

TILE = (300, 330)
"""Width and height of one hand in pixels."""
PIXELS_PER_METRE = 1080.0
SKIN = np.array([150.0, 185.0, 230.0])
"""Colour, blue green red."""
LIGHT = np.array([-0.35, -0.55, -0.75])
"""Direction to the light; x right, y down, z away from the eye."""


def sample_sheet(seed: int) -> NDArray[np.uint8]:
    """Twelve hands with normal alpha and beta in two rows: palms, and backs of half-closed hands.

    All tiles have one scale, so that sizes can be compared.
    """
    model = HandModel.load()
    rng = np.random.default_rng(seed)
    low, high = model.limits.T
    relaxed = np.clip(model.rest_angles + np.radians(22.0) * (model.dof_axes[:, 2] > 0), low, high)
    tiles = []
    for k in range(12):
        hand = model.shaped(model.sample_shape(rng))
        angles, palmar = (model.rest_angles, True) if k < 6 else (relaxed, False)
        tiles.append(_tile(hand, angles, palmar=palmar))
    return np.vstack([np.hstack(tiles[:6]), np.hstack(tiles[6:])])


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes a PNG of at most 64 colours, which keeps it small."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), (image // 4) * 4, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise OSError(f"could not write {path}")


def _tile(hand: ShapedHand, angles: Float, *, palmar: bool) -> NDArray[np.uint8]:
    """One hand seen from its palm or its back, fingers up."""
    pose = np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], angles])
    vertices = skin(hand, pose)
    side = 1.0 if palmar else -1.0
    view = np.array([[0.0, 0.0, side], [-1.0, 0.0, 0.0], [0.0, -side, 0.0]])
    # Without the cap (around the last vertex), whose normals would darken the cut's rim.
    faces = hand.faces[(hand.faces != hand.nvert - 1).all(axis=1)]
    return shade(vertices @ view.T, faces, centre=np.array([0.0, -0.07]))


def shade(points: Float, faces: NDArray[np.int32], *, centre: Float) -> NDArray[np.uint8]:
    """Orthographic picture of a mesh with smooth shading.

    Args:
        points: Vertices [m], shape (nvert, 3), x right, y down, z away.
        faces: Triangles, shape (nface, 3).
        centre: What lies in the middle of the picture [m], shape (2,).

    Returns:
        Picture, shape (height, width, 3), BGR.
    """
    width, height = TILE
    pixels = (points[:, :2] - centre) * PIXELS_PER_METRE + np.array([width, height]) / 2
    light = LIGHT / np.linalg.norm(LIGHT)
    bright = 0.25 + 0.75 * np.clip(vertex_normals(points, faces) @ light, 0.0, 1.0)
    depth = np.full((height, width), np.inf)
    picture = np.full((height, width, 3), 255.0)
    for face in faces:
        (x0, y0), (x1, y1), (x2, y2) = pixels[face]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-9:
            continue
        left, right = int(np.ceil(min(x0, x1, x2))), int(max(x0, x1, x2))
        top, bottom = int(np.ceil(min(y0, y1, y2))), int(max(y0, y1, y2))
        left, top = max(left, 0), max(top, 0)
        right, bottom = min(right, width - 1), min(bottom, height - 1)
        if left > right or top > bottom:
            continue
        y, x = np.mgrid[top : bottom + 1, left : right + 1]
        b1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / area
        b2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / area
        b0 = 1.0 - b1 - b2
        z0, z1, z2 = points[face, 2]
        z = b0 * z0 + b1 * z1 + b2 * z2
        window = (slice(top, bottom + 1), slice(left, right + 1))
        seen = (b0 >= -1e-9) & (b1 >= -1e-9) & (b2 >= -1e-9) & (z < depth[window])
        depth[window][seen] = z[seen]
        tone = b0 * bright[face[0]] + b1 * bright[face[1]] + b2 * bright[face[2]]
        picture[window][seen] = tone[seen, None] * SKIN
    return picture.astype(np.uint8)
