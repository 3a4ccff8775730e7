"""The hand and what was observed of it, seen from another side than the camera's.

Depth and overlay show how well a pose explains the image; from the side one sees how deep the
fingers are, which the image hides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import moved_poses, rotvec_to_matrix
from handtrack.viewer.depth_colours import EMPTY_COLOUR, Image
from handtrack.viewer.pictures import (
    FINGER_COLOURS,
    PIXELS_PER_METRE,
    SKIN,
    check_panel,
    draw_skeleton,
    drawable_pose,
    followed,
)
from handtrack.viewer.shading import Colour, finger_tints, shade_mesh, wrist_fade

EYE_DISTANCE = 0.6
"""Distance from the eye to the middle of the hand [m]."""

POINT_COLOUR: Colour = (190, 150, 92)
"""Colour of observed points, B G R."""

REACH = 0.35
"""Points farther than this from the hand [m] are left out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SideStyle:
    """How side views look."""

    panel: tuple[int, int] = (480, 480)
    """Width and height [pixels]."""
    span: float = 0.34
    """Width of the view at the hand's distance [m]."""
    turn: float = 75.0
    """Angle about the vertical from the camera's place to the eye's [degrees]; positive is to the
    camera's left."""
    rise: float = 15.0
    """Angle of the eye above the horizontal [degrees]."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        check_panel(self.panel)
        if not 0.05 <= self.span <= 5.0:
            raise InputError(f"span is {self.span}: expected 0.05 to 5 m")
        if not (-180 <= self.turn <= 180 and -90 <= self.rise <= 90):
            raise InputError(
                f"turn and rise are {self.turn} and {self.rise}: expected -180 to 180 and -90 to 90"
            )


class SidePainter:
    """Draws poses of one hand, with the points that one camera saw, from a side."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        style: SideStyle | None = None,
        device: str | None = "cpu",
    ) -> None:
        """Prepare buffers.

        Args:
            hand: The hand whose poses are drawn.
            camera: Camera of the depth images.
            style: How pictures look.
            device: Where the mesh is rendered.
        """
        self.hand, self.camera = hand, camera
        self.style = style if style is not None else SideStyle()
        width, height = self.style.panel
        focal = width * EYE_DISTANCE / self.style.span
        self.eye = Camera(
            width=width, height=height, fx=focal, fy=focal, cx=0.5 * (width - 1),
            cy=0.5 * (height - 1),
        )  # fmt: skip
        self._renderer = DepthRenderer(hand, self.eye, device=device, batch=1)
        self._tints = finger_tints(hand, SKIN, FINGER_COLOURS, 0.3)
        self._fade = wrist_fade(hand)
        turn, rise = np.deg2rad([self.style.turn, self.style.rise])
        self._R_eye_camera = rotvec_to_matrix([rise, 0, 0]) @ rotvec_to_matrix([0, -turn, 0])
        self._centre: NDArray[np.float64] | None = None

    def paint(self, depth: ArrayLike, pose: ArrayLike | None) -> Image:
        """Picture of a pose and of the points around it.

        Args:
            depth: Depth [m], shape (height, width) of the camera, 0 = no measurement.
            pose: Pose, shape (28,); None, or one that is not finite, draws the points alone, around
                where the hand was last.

        Returns:
            Picture, uint8, channels B G R, of the style's size.

        Raises:
            InputError: The depth image or the pose has the wrong shape.
        """
        where = drawable_pose(pose)
        points = self.camera.points(depth).reshape(-1, 3)
        points = points[points[:, 2] > 0].astype(np.float64)
        joints = None if where is None else keypoints(self.hand, where)
        picture = np.full((self.eye.height, self.eye.width, 3), EMPTY_COLOUR, np.uint8)
        if joints is not None:
            self._centre = followed(self._centre, joints.mean(axis=0))
        if self._centre is None:
            return picture
        surface = np.zeros(self.eye.shape, np.float32)
        if where is not None:
            mesh = shade_mesh(self._renderer, self._seen_pose(where), self._tints, self._fade)
            surface = mesh.depth
            cover = mesh.opacity[..., None]
            picture = np.rint(picture * (1 - cover) + mesh.picture * cover).astype(np.uint8)
        near = np.linalg.norm(points - self._centre, axis=1) < REACH
        self._draw_points(picture, surface, self._seen(points[near]))
        if joints is not None:
            size = self.eye.fx / EYE_DISTANCE / PIXELS_PER_METRE
            draw_skeleton(picture, self.eye.project(self._seen(joints)), size=size)
        return picture

    def cut(self) -> None:
        """The next picture is not of the same take: the view need not follow."""
        self._centre = None

    def _seen(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the camera's frame in the eye's [m], shape (n, 3)."""
        assert self._centre is not None
        return (points - self._centre) @ self._R_eye_camera.T + [0.0, 0.0, EYE_DISTANCE]

    def _seen_pose(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """A pose in the camera's frame as a pose in the eye's, shape (28,)."""
        return moved_poses(pose, self._R_eye_camera, self._seen(np.zeros((1, 3)))[0])

    def _draw_points(
        self, picture: Image, surface: NDArray[np.float32], points: NDArray[np.float64]
    ) -> None:
        """Draw those points that the mesh does not hide, the far ones first."""
        pixels = self.eye.project(points)
        inside = (
            np.isfinite(pixels).all(axis=1)
            & (pixels >= 0).all(axis=1)
            & (pixels < [self.eye.width - 1, self.eye.height - 1]).all(axis=1)
        )
        pixels, z = np.rint(pixels[inside]).astype(int), points[inside, 2]
        before = surface[pixels[:, 1], pixels[:, 0]]
        shown = (before == 0) | (z < before + 0.003)
        radius = max(1, round(self.eye.width / 480))
        for place in np.flatnonzero(shown)[np.argsort(-z[shown])]:
            u, v = int(pixels[place, 0]), int(pixels[place, 1])
            cv2.circle(picture, (u, v), radius, POINT_COLOUR, -1)
