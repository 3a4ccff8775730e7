"""Shading of the hand's mesh: which surface each pixel sees, its normal, and the light on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.hand.model import ShapedHand, vertex_normals
from handtrack.hand.skeleton import FINGERS, NBONE, finger_of_bone
from handtrack.synthesis.renderer import DepthRenderer

Colour = tuple[int, int, int]
Float = NDArray[np.float64]

LIGHT = np.array([-0.45, -0.65, -0.62])
"""Direction towards the light, camera frame: from above left, behind the viewer."""

_AMBIENT, _SPECULAR, _GLOSS = 0.40, 0.20, 24


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadedMesh:
    """A lit mesh in the pixels of a camera."""

    depth: NDArray[np.float32]
    """Depth of the mesh [m], shape (height, width), 0 where it is not."""
    picture: NDArray[np.float32]
    """Colour, 0 to 255, shape (height, width, 3), B G R; 0 where the mesh is not."""
    opacity: NDArray[np.float32]
    """The vertices' opacity, 0 to 1, shape (height, width); 0 where the mesh is not."""


def finger_tints(
    hand: ShapedHand, skin: Colour, fingers: tuple[Colour, ...], share: float
) -> Float:
    """Colour of every vertex, shape (nvert, 3): the skin's, tinted by the finger it moves with."""
    owner = np.array([finger_of_bone(bone) for bone in range(NBONE)])
    belongs = np.zeros((hand.nvert, len(FINGERS)))
    for finger in range(len(FINGERS)):
        mine = owner[hand.weight_bones] == finger
        belongs[:, finger] = (hand.weights * mine).sum(1)
    base = np.array(skin, np.float64)
    return base + share * (belongs @ (np.array(fingers, np.float64) - base))


def wrist_fade(hand: ShapedHand) -> Float:
    """Opacity of every vertex, shape (nvert,): the model's stub of forearm fades out.

    The stub is rigid with the palm while a wrist bends, so it explains nothing.
    """
    palm_x = np.where(hand.weight_bones == 0, hand.local_vertices[..., 0], np.inf).min(axis=1)
    return np.clip((palm_x - 0.8 * hand.cut_x) / (-0.7 * hand.cut_x), 0.0, 1.0)


def shade_mesh(
    renderer: DepthRenderer, pose: NDArray[np.float64], tints: Float, opacity: Float
) -> ShadedMesh:
    """Light the hand by Lambert's law, with a soft highlight.

    Args:
        renderer: Renderer of the hand, aimed at what the picture shows.
        pose: Pose, shape (28,), finite.
        tints: Colour of each vertex, shape (nvert, 3), B G R.
        opacity: Opacity of each vertex, shape (nvert,).
    """
    depth, items, vertices, faces = renderer.surface(pose)
    return light_surface(
        depth, items, vertices[: renderer.hand.nvert], faces, renderer.camera, tints, opacity
    )


def light_surface(
    depth: NDArray[np.float32], items: NDArray[np.int64], vertices: Float, faces: NDArray[np.int32],
    camera: Camera, tints: Float, opacity: Float,
) -> ShadedMesh:  # fmt: skip
    """Light a mesh that was drawn, as `shade_mesh` does.

    Args:
        depth: Depth [m], 0 = nothing, shape (height, width).
        items: Triangle seen in each pixel, same shape.
        vertices: Vertices [m], camera frame, shape (nvert, 3).
        faces: Triangles, outward, shape (nface, 3).
        camera: Camera of the image.
        tints: Colour of each vertex, shape (nvert, 3), B G R.
        opacity: Opacity of each vertex, shape (nvert,).
    """
    seen = depth > 0
    corners = faces[items[seen]]
    points = _back_project(depth, seen, camera)
    shares = _barycentric(points, vertices[corners])
    normals = vertex_normals(vertices, faces)
    normal = _unit(np.einsum("pk,pki->pi", shares, normals[corners]))
    colour = np.einsum("pk,pki->pi", shares, tints[corners])

    light, view = _unit(LIGHT), -_unit(points)
    # Half-Lambert: the shaded side keeps its form instead of turning flat.
    diffuse = (0.5 + 0.5 * (normal @ light)) ** 1.6
    highlight = np.maximum((normal * _unit(light + view)).sum(1), 0.0) ** _GLOSS
    brightness = _AMBIENT + (1.0 - _AMBIENT) * diffuse
    # Grazing surfaces darken, which sets fingers off from what lies behind them.
    rim = 0.6 + 0.4 * np.clip((normal * view).sum(1) / 0.55, 0.0, 1.0)
    lit = colour * (brightness * rim)[:, None] + 255 * _SPECULAR * highlight[:, None]
    picture = np.zeros((*depth.shape, 3), np.float32)
    picture[seen] = np.clip(lit, 0, 255)
    cover = np.zeros(depth.shape, np.float32)
    cover[seen] = (shares * opacity[corners]).sum(1)
    return ShadedMesh(depth=depth, picture=picture, opacity=cover)


def _back_project(depth: NDArray[np.float32], seen: NDArray[np.bool_], camera: Camera) -> Float:
    """Points [m], shape (n, 3), of the pixels that are seen."""
    rows, columns = np.nonzero(seen)
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    return camera.unproject(pixels, depth[seen].astype(np.float64))


def _barycentric(points: Float, corners: Float) -> Float:
    """Shares of a triangle's corners, shape (n, 3), in points on it; corners: (n, 3, 3)."""
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1)
    pa, pb = (p * a).sum(1), (p * b).sum(1)
    area = np.maximum(aa * bb - ab * ab, 1e-18)
    v, w = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    shares = np.clip(np.stack([1 - v - w, v, w], -1), 0.0, 1.0)
    return shares / np.maximum(shares.sum(1, keepdims=True), 1e-9)


def _unit(vectors: Float) -> Float:
    """Vectors of length one, shape (..., 3)."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
