"""Pictures of a hand and the things it grasps on their table, drawn without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.device import resolve_device
from handtrack.errors import InputError
from handtrack.hand.kinematics import skin
from handtrack.hand.model import ShapedHand
from handtrack.kernels.render import key_item_numpy, render_keys, unpack_depth
from handtrack.objects.rigid_object import RigidObject
from handtrack.transforms import quat_to_matrix
from handtrack.viewer.depth_colours import Image
from handtrack.viewer.pictures import FINGER_COLOURS, SKIN, check_panel
from handtrack.viewer.shading import (
    LIGHT,
    Colour,
    ShadedMesh,
    finger_tints,
    light_surface,
    wrist_fade,
)

Float = NDArray[np.float64]

BACKGROUND: Colour = (244, 242, 240)
TABLE_COLOURS: tuple[Colour, Colour] = ((196, 204, 208), (182, 190, 194))
"""Light and dark squares of the table, B G R."""
THING_COLOURS: tuple[Colour, ...] = (
    (178, 114, 0), (0, 94, 213), (115, 158, 0), (167, 121, 204), (66, 228, 240),
    (0, 159, 230), (233, 180, 86),
)  # fmt: skip
"""Objects in their order, B G R; told apart by colour-blind readers too (Okabe and Ito)."""

SQUARE, SQUARES = 0.05, 24
"""Edge of the table's squares [m], and how many there are along each side."""

SHADOW, BLUR = 0.5, 0.008
"""How much darker the table is in shadow; how soft its edge is, as a share of the view's width."""
SLANT = 0.4
"""Shadows fall so much as far aside as the light that shades would throw them: then they tell
height, and stay in the picture."""
SUNK = 0.01
"""What is farther under the table casts no shadow [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspStyle:
    """How pictures of grasps look."""

    panel: tuple[int, int] = (640, 480)
    """Width and height [pixels]."""
    span: float = 0.65
    """Width of the view at what it looks at [m]."""
    distance: float = 1.2
    """From the eye to what it looks at [m]."""
    azimuth: float = 60.0
    """Where the eye is about the vertical [degrees], counter-clockwise from x."""
    rise: float = 28.0
    """Angle of the eye above the table [degrees]."""
    centre: tuple[float, float, float] = (0.08, 0.0, 0.12)
    """What the eye looks at [m]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        check_panel(self.panel)
        if not (0.05 <= self.span <= 5.0 and 0.3 <= self.distance <= 10.0):
            raise InputError(
                f"span is {self.span} and distance {self.distance}: expected 0.05 to 5 m and 0.3 "
                "to 10 m"
            )
        if not 1.0 <= self.rise <= 89.0:
            raise InputError(f"rise is {self.rise}: expected 1 to 89 degrees")


class GraspPainter:
    """Draws one hand, some objects and the table z = 0, seen from a fixed place.

    What is above the table casts a soft shadow on it, straight below and a little aside.
    """

    def __init__(
        self,
        hand: ShapedHand,
        things: Sequence[RigidObject],
        *,
        style: GraspStyle | None = None,
        device: str | None = "cpu",
    ) -> None:
        """Prepare buffers.

        Args:
            hand: The hand.
            things: The objects.
            style: How pictures look.
            device: Where meshes are drawn.
        """
        self.hand, self.style = hand, style if style is not None else GraspStyle()
        width, height = self.style.panel
        focal = width * self.style.distance / self.style.span
        self.camera = Camera(
            width=width, height=height, fx=focal, fy=focal, cx=0.5 * (width - 1),
            cy=0.5 * (height - 1),
        )  # fmt: skip
        self._R_eye_world, self._eye = _looking(self.style)
        # Corners are not shared between triangles, so that edges stay sharp.
        self._corners = [np.asarray(t.vertices, np.float64)[t.faces.ravel()] for t in things]
        table, table_tints = _table()
        parts = [len(corners) for corners in self._corners] + [len(table)]
        self._table = self._seen(table)
        first = np.cumsum([hand.nvert, *parts])[:-1]
        soups = [
            start + np.arange(count, dtype=np.int32).reshape(-1, 3)
            for start, count in zip(first.tolist(), parts, strict=True)
        ]
        self._faces = np.concatenate([hand.faces, *soups]).astype(np.int32)
        colours = [THING_COLOURS[k % len(THING_COLOURS)] for k in range(len(things))]
        self._tints = np.concatenate([
            finger_tints(hand, SKIN, FINGER_COLOURS, 0.3),
            *(np.tile(c, (n, 1)) for c, n in zip(colours, parts[:-1], strict=True)),
            table_tints,
        ])  # fmt: skip
        self._opacity = np.concatenate([wrist_fade(hand), np.ones(sum(parts))])
        where = resolve_device(device)
        self._triangles = {
            hidden: wp.array(self._faces[hidden:], dtype=int, device=where)
            for hidden in (0, len(hand.faces))
        }
        self._table_face = len(self._faces) - len(table) // 3
        self._casters = wp.array(self._faces[: self._table_face], dtype=int, device=where)
        light = self._R_eye_world.T @ LIGHT
        self._shift = SLANT * light[:2] / light[2]
        self._vertices = wp.zeros((1, len(self._tints)), dtype=wp.vec3, device=where)
        self._keys = wp.zeros((1, height, width), dtype=wp.int64, device=where)
        self._depth = wp.zeros((1, height, width), dtype=float, device=where)
        self._row = wp.zeros(1, dtype=int, device=where)
        lens = np.array([[focal, focal, self.camera.cx, self.camera.cy]], np.float32)
        self._cameras = wp.array(lens, dtype=float, device=where)

    def paint(self, hand_pose: ArrayLike, object_poses: ArrayLike) -> Image:
        """One picture.

        Args:
            hand_pose: The hand in the world, shape (28,).
            object_poses: Every object's centre [m] and quaternion, shape (nobject, 7).

        Returns:
            Picture, uint8, channels B G R, of the style's size.

        Raises:
            InputError: Shapes do not fit.
        """
        pose, places = np.asarray(hand_pose, np.float64), np.asarray(object_poses, np.float64)
        if pose.shape != (28,) or places.shape != (len(self._corners), 7):
            raise InputError(
                f"poses have shapes {pose.shape} and {places.shape}; expected (28,) and "
                f"({len(self._corners)}, 7)"
            )
        parts = [skin(self.hand, pose)]
        for corners, place in zip(self._corners, places, strict=True):
            parts.append(corners @ quat_to_matrix(place[3:]).T + place[:3])
        casters = np.concatenate(parts)
        bright = 1.0 - SHADOW * self._shadow(casters)
        vertices = np.concatenate([self._seen(casters), self._table])
        self._vertices.assign(vertices[None].astype(np.float32))
        mesh = self._lit(vertices, 0, None, bright)
        # The forearm's stub fades out: what is behind it is drawn without the hand.
        faint = mesh.opacity < 1.0
        behind = self._lit(vertices, len(self.hand.faces), faint, bright)
        picture = np.full(mesh.picture.shape, BACKGROUND, np.float64)
        for layer in (behind, mesh):
            cover = layer.opacity[..., None]
            picture = picture * (1.0 - cover) + layer.picture * cover
        return np.rint(picture).astype(np.uint8)

    def _shadow(self, points: Float) -> Float:
        """Where the table lies in shadow, 0 to 1, shape (height, width).

        Args:
            points: Vertices of hand and objects in the world [m], shape (n, 3).
        """
        flat = np.zeros_like(points)
        flat[:, :2] = points[:, :2] - points[:, 2:] * self._shift
        # Flattened meshes: of a closed one, the faces towards the light cover the whole shadow.
        seen = self._seen(flat)
        seen[points[:, 2] < -SUNK] = 0.0  # in the eye itself: not drawn
        self._vertices.assign(np.concatenate([seen, self._table])[None].astype(np.float32))
        _, items = self._drawn(self._casters)
        strength = self._opacity[self._faces].mean(axis=1)
        shade = np.where(items >= 0, strength[items], 0.0)
        return cv2.GaussianBlur(shade, (0, 0), BLUR * self.style.panel[0]).astype(np.float64)

    def _lit(
        self, vertices: Float, hidden: int, where: NDArray[np.bool_] | None, bright: Float
    ) -> ShadedMesh:
        """The mesh without its first `hidden` triangles, in all pixels or some.

        Args:
            vertices: Everything in the eye's frame [m], shape (nvert, 3).
            hidden: So many triangles are left out.
            where: Pixels that are wanted; None: all.
            bright: Brightness of the table, 0 to 1, shape (height, width).
        """
        depth, items = self._drawn(self._triangles[hidden])
        if where is not None:
            depth = np.where(where, depth, np.float32(0.0))
            items = np.where(where, items, -1)
        mesh = light_surface(
            depth, items, vertices, self._faces[hidden:], self.camera, self._tints, self._opacity
        )
        table = items >= self._table_face - hidden
        mesh.picture[table] *= bright[table][:, None]
        return mesh

    def _drawn(self, triangles: wp.array) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Depth [m], 0 = nothing, and number of the triangle, -1 = none, of every pixel."""
        render_keys(triangles, self._row, self._cameras, self._vertices, keys=self._keys)
        unpack_depth(self._keys, depth=self._depth)
        depth = self._depth.numpy()[0]
        return depth, np.where(depth > 0, key_item_numpy(self._keys.numpy()[0]), -1)

    def _seen(self, points: Float) -> Float:
        """Points of the world in the eye's frame [m], shape (n, 3)."""
        return (points - self._eye) @ self._R_eye_world.T


def _looking(style: GraspStyle) -> tuple[Float, Float]:
    """Rotation from the world to the eye's frame (x right, y down, z forward), and the eye [m]."""
    azimuth, rise = np.deg2rad([style.azimuth, style.rise])
    forward = -np.array(
        [np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)]
    )
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    return turn, np.asarray(style.centre) - style.distance * forward


def _table() -> tuple[Float, Float]:
    """Corners of the table's triangles [m], shape (n, 3), and their colours, shape (n, 3)."""
    half = 0.5 * SQUARE * SQUARES
    unit = SQUARE * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    at = np.stack(np.meshgrid(np.arange(SQUARES), np.arange(SQUARES), indexing="ij"), -1)
    at = at.reshape(-1, 2)
    corners = np.concatenate([SQUARE * at - half, np.zeros((len(at), 1))], axis=1)
    colours = np.array(TABLE_COLOURS, np.float64)[at.sum(1) % 2]
    return (corners[:, None] + unit).reshape(-1, 3), np.repeat(colours, len(unit), axis=0)
