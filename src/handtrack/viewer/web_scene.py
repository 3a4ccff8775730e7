"""The 3D scene of the web viewer: observed points, hand mesh, skeleton, keypoints, hypotheses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.frame import DepthFrame
from handtrack.hand.skeleton import FINGERS, NKEYPOINT
from handtrack.tracking.result import HandResult, TrackState
from handtrack.viewer.pictures import FINGER_COLOURS, WRIST_COLOUR
from handtrack.viewer.viewer import Hypotheses, View

if TYPE_CHECKING:
    import viser

MOST_POINTS = 20_000
"""The image is thinned out to about so many points: more are not told apart on a screen."""

POINT_SIZE = 0.0012
"""Width of an observed point [m]."""

POINT_COLOUR = (92, 150, 190)
SKIN = (236, 205, 178)
LOST_SKIN = (150, 150, 150)
MESH_OPACITY = 0.75
"""The skeleton shines through."""
GOOD, BAD = np.array([90, 220, 120]), np.array([235, 80, 70])
"""Colours of the best and of the worst hypothesis, R G B."""

WORST_ERROR = 0.02
"""Depth error from which on a hypothesis has the colour of the worst [m]."""

BONES: NDArray[np.intp] = np.array([
    (0 if joint == 0 else 4 * finger + joint, 4 * finger + joint + 1)
    for finger in range(len(FINGERS)) for joint in range(4)
])  # fmt: skip
"""Keypoints at both ends of each bone, shape (20, 2), from the wrist outward."""

_FINGER_RGB = np.array([colour[::-1] for colour in FINGER_COLOURS], np.uint8)
_BONE_RGB = np.repeat(_FINGER_RGB, 4, axis=0)
_KEYPOINT_RGB = np.concatenate([np.array([WRIST_COLOUR[::-1]], np.uint8), _BONE_RGB])
_NOTHING = np.zeros((1, 3), np.float32)

DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "front": (-0.35, -0.3, -1.0),
    "camera": (0.0, 0.0, -1.0),
    "left": (-1.0, -0.25, -0.15),
    "right": (1.0, -0.25, -0.15),
    "above": (0.0, -1.0, -0.35),
}
"""Name of a look at the hand -> where the eye is from there, camera frame."""

FIRST_LOOK = "front"
"""Where the eye is at first."""

_EYE_DISTANCE = 0.42


class WebScene:
    """The scene's nodes; each view changes what they hold."""

    def __init__(self, server: viser.ViserServer) -> None:
        """Add the nodes, hidden until there is something to see.

        Args:
            server: The web server, whose scene is empty.
        """
        self.show_points = self.show_mesh = self.show_skeleton = True
        self._centre: NDArray[np.float64] | None = None
        scene = server.scene
        # Camera frame: y points down.
        scene.set_up_direction("-y")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/light/ambient", intensity=1.1)
        # From behind the camera's left shoulder, as in the pictures of `viewer.shading`.
        scene.add_light_directional("/light/key", intensity=2.6, position=(-0.45, -0.65, -0.62))
        scene.add_light_directional("/light/fill", intensity=0.8, position=(0.8, 0.1, -0.3))
        self._points = scene.add_point_cloud(
            "/points", _NOTHING, POINT_COLOUR, point_size=POINT_SIZE, point_shape="circle",
            point_shading="flat", visible=False,
        )  # fmt: skip
        self._mesh: viser.MeshHandle | None = None
        self._scene = scene
        self._bones = scene.add_line_segments(
            "/skeleton/bones", np.zeros((len(BONES), 2, 3), np.float32),
            np.repeat(_BONE_RGB[:, None], 2, axis=1), thickness=3.0, thickness_units="screen",
            visible=False,
        )  # fmt: skip
        self._keypoints = scene.add_point_cloud(
            "/skeleton/keypoints", np.zeros((NKEYPOINT, 3), np.float32), _KEYPOINT_RGB,
            point_size=0.007, point_shape="circle", point_shading="flat", precision="float32",
            visible=False,
        )  # fmt: skip
        self._hypotheses: viser.LineSegmentsHandle | None = None
        camera = server.initial_camera
        camera.position, camera.look_at = eye_at(FIRST_LOOK, np.array([0.0, 0.0, 0.5]))
        camera.near = 0.01

    @property
    def centre(self) -> NDArray[np.float64]:
        """The middle of the hand when it was last seen [m], shape (3,)."""
        return np.array([0.0, 0.0, 0.5]) if self._centre is None else self._centre

    def draw(self, view: View) -> None:
        """Show a view."""
        self._draw_points(view.frame)
        self._draw_hand(view.hand)
        self._draw_hypotheses(view.hypotheses)

    def _draw_points(self, frame: DepthFrame) -> None:
        """The depth image as points."""
        points = scene_points(frame) if self.show_points else _NOTHING[:0]
        change(self._points, visible=len(points) > 0)
        if len(points):
            self._points.points = points.astype(np.float16)

    def _draw_hand(self, hand: HandResult) -> None:
        """Mesh and skeleton, grey where the hand is lost."""
        seen = hand.state is not TrackState.NO_HAND
        lost = hand.state is TrackState.LOST
        if seen and self.show_mesh:
            if self._mesh is None:
                self._mesh = self._scene.add_mesh_simple(
                    "/hand", hand.vertices, hand.faces, color=SKIN, opacity=MESH_OPACITY,
                    cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
            self._mesh.vertices = hand.vertices
            change(self._mesh, color=LOST_SKIN if lost else SKIN)
        if self._mesh is not None:
            change(self._mesh, visible=seen and self.show_mesh)
        if seen:
            points = hand.keypoints
            self._centre = points.mean(axis=0, dtype=np.float64)
            self._bones.points = points[BONES]
            self._keypoints.points = points
        for node in (self._bones, self._keypoints):
            change(node, visible=seen and self.show_skeleton)

    def _draw_hypotheses(self, hypotheses: Hypotheses | None) -> None:
        """Skeletons of all candidates, from green to red by their depth error."""
        if self._hypotheses is not None and (
            hypotheses is None or self._hypotheses.points.shape[0] != _segments(hypotheses)
        ):
            self._hypotheses.remove()
            self._hypotheses = None
        if hypotheses is None:
            return
        points = hypotheses.keypoints[:, BONES].reshape(-1, 2, 3)
        share = np.clip(hypotheses.errors / WORST_ERROR, 0.0, 1.0)[:, None]
        colours = np.rint(GOOD + share * (BAD - GOOD)).astype(np.uint8)
        colours = np.broadcast_to(
            colours[:, None, None], (len(colours), len(BONES), 2, 3)
        ).reshape(-1, 2, 3)  # fmt: skip
        if self._hypotheses is None:
            self._hypotheses = self._scene.add_line_segments(
                "/hypotheses", points, colours, thickness=1.5, thickness_units="screen"
            )
        else:
            self._hypotheses.points, self._hypotheses.colors = points, colours


def scene_points(frame: DepthFrame) -> NDArray[np.float32]:
    """Observed points of a frame [m], shape (n, 3), n about `MOST_POINTS` at most."""
    seen = int(np.count_nonzero(frame.depth > 0))
    step = max(1, math.ceil(math.sqrt(seen / MOST_POINTS)))
    depth = frame.depth[::step, ::step]
    return frame.camera.thin(step).points(depth)[depth > 0]


def eye_at(
    direction: str, centre: NDArray[np.float64]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Eye and the point that it looks at [m], camera frame.

    Args:
        direction: One of `DIRECTIONS`.
        centre: What to look at [m], shape (3,).
    """
    away = np.array(DIRECTIONS[direction])
    eye = centre + _EYE_DISTANCE * away / np.linalg.norm(away)
    x, y, z = (float(value) for value in eye)
    u, v, w = (float(value) for value in centre)
    return (x, y, z), (u, v, w)


def change(node: Any, **properties: Any) -> None:
    """Set what differs of an element of the page, and send nothing otherwise."""
    for name, value in properties.items():
        if getattr(node, name) != value:
            setattr(node, name, value)


def _segments(hypotheses: Hypotheses) -> int:
    """Line segments that show hypotheses."""
    return len(hypotheses.keypoints) * len(BONES)
