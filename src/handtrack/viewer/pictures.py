"""Overlay pictures: the tracked mesh and skeleton drawn over the depth image they explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import InputError
from handtrack.hand.kinematics import keypoints, palm_centre
from handtrack.hand.model import ShapedHand
from handtrack.hand.skeleton import FINGERS, NKEYPOINT, NQ
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.result import HandResult, TrackState
from handtrack.viewer.depth_colours import EMPTY_COLOUR, Image, colour_depth, depth_range
from handtrack.viewer.shading import Colour, finger_tints, shade_mesh, wrist_fade

FINGER_COLOURS: tuple[Colour, ...] = (
    (0, 159, 230), (235, 185, 90), (115, 175, 20), (40, 105, 230), (190, 125, 215),
)  # fmt: skip
"""Thumb to little finger, B G R; told apart by colour-blind readers too (Okabe and Ito)."""
WRIST_COLOUR: Colour = (235, 235, 235)
STATE_COLOURS: dict[TrackState, Colour] = {
    TrackState.TRACKING: (130, 205, 120),
    TrackState.RECOVERED: (80, 200, 240),
    TrackState.LOST: (90, 90, 240),
    TrackState.NO_HAND: (170, 170, 170),
}
"""Colour of the word that names the state, B G R."""

INK: Colour = (240, 240, 240)
"""Colour of text, B G R."""
SKIN: Colour = (178, 201, 226)
"""Colour of the mesh, B G R."""

_LOST_SKIN: Colour = (140, 140, 150)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SUBPIXEL_BITS = 4
_FOLLOW = 0.15

PIXELS_PER_METRE = 1400.0
"""Scale of a view at which lines and dots have their usual size [1/m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureStyle:
    """How overlay pictures look."""

    panel: tuple[int, int] = (640, 480)
    """Width and height of one panel [pixels]."""
    zoom: float | None = None
    """Width of the view at the hand's distance [m]; None shows the whole image."""
    side_by_side: bool = True
    """Put the plain depth image to the left of the overlay."""
    mesh_opacity: float = 0.88
    """Opacity of the mesh where nothing measured lies before it; 0 draws no mesh."""
    hidden_opacity: float = 0.25
    """Opacity of the mesh where something measured lies before it."""
    hidden_margin: float = 0.02
    """So much nearer than the mesh [m] must a measurement be to hide it."""
    tint: float = 0.3
    """How much the mesh takes on the colours of the fingers, 0 to 1."""
    skeleton: bool = True
    """Draw keypoints and bones."""
    text: bool = True
    """Write state, frame and depth error."""
    supersample: int = 2
    """Mesh pixels per picture pixel along each side, for smooth outlines."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: A setting is out of range.
        """
        check_panel(self.panel)
        if self.zoom is not None and not 0.05 <= self.zoom <= 5.0:
            raise InputError(f"zoom is {self.zoom}: expected a width of 0.05 to 5 m, or None")
        for name in ("mesh_opacity", "hidden_opacity", "tint"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{name} is {getattr(self, name)}: expected 0 to 1")
        if self.supersample not in (1, 2, 3, 4):
            raise InputError(f"supersample is {self.supersample}: expected 1 to 4")


class OverlayPainter:
    """Draws results of one hand on the depth images of one camera."""

    def __init__(
        self,
        hand: ShapedHand,
        camera: Camera,
        *,
        style: PictureStyle | None = None,
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
        self.style = style if style is not None else PictureStyle()
        self._view = _fit_view(camera, self.style.panel)
        fine = _finer(self._view, self.style.supersample)
        self._renderer = DepthRenderer(hand, fine, device=device, batch=1)
        self._tints = finger_tints(hand, SKIN, FINGER_COLOURS, self.style.tint)
        self._lost_tints = finger_tints(hand, _LOST_SKIN, FINGER_COLOURS, 0.0)
        self._fade = wrist_fade(hand)
        self._range: tuple[float, float] | None = None
        self._centre: NDArray[np.float64] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures [pixels]."""
        width, height = self.style.panel
        return width * (2 if self.style.side_by_side else 1), height

    def paint_result(
        self, depth: ArrayLike, result: HandResult, *, index: int | None = None
    ) -> Image:
        """Picture of one tracked frame, with its state, number and depth error.

        Args:
            depth: Depth [m], shape (height, width) of the camera.
            result: What the tracker found in it.
            index: Number of the frame.
        """
        state = result.state
        lines = [(state.value.replace("_", " "), STATE_COLOURS[state])]
        if np.isfinite(result.depth_error):
            lines.append((f"depth error {1e3 * result.depth_error:.1f} mm", INK))
        if result.problem is not None and state in (TrackState.LOST, TrackState.NO_HAND):
            lines.append((_shorten(result.problem, 52), INK))
        pose = None if state is TrackState.NO_HAND else result.pose
        title = "" if index is None else f"frame {index}"
        return self.paint(depth, pose, title=title, lines=lines, lost=state is TrackState.LOST)

    def paint(
        self,
        depth: ArrayLike,
        pose: ArrayLike | None,
        *,
        title: str = "",
        lines: Sequence[tuple[str, Colour]] = (),
        lost: bool = False,
    ) -> Image:
        """Picture of a pose over a depth image.

        Consecutive calls move the view and the colours' range gently, as a video needs it; `cut`
        lets go of the past.

        Args:
            depth: Depth [m], shape (height, width) of the camera; pixels that are not finite and
                positive are drawn as empty.
            pose: Pose, shape (28,); None, or one that is not finite, draws the depth alone.
            title: Text over the depth image, such as the frame's number.
            lines: Texts over the overlay with their colours, B G R.
            lost: Grey mesh, for a pose that does not explain the image.

        Returns:
            Picture, shape (height, width, 3) of `size`, uint8, channels B G R.

        Raises:
            InputError: The depth image or the pose has the wrong shape.
        """
        image = np.asarray(depth, np.float32)
        if image.shape != self.camera.shape:
            raise InputError(f"depth has shape {image.shape}: expected {self.camera.shape}")
        image = np.where(np.isfinite(image) & (image > 0), image, 0.0).astype(np.float32)
        where = drawable_pose(pose)
        points = None if where is None else keypoints(self.hand, where)
        self._follow(image, points)
        assert self._range is not None
        ground = self._enlarge(colour_depth(image, *self._range, grey=True))
        if where is not None and self.style.mesh_opacity > 0 and where[2] > 0:
            self._lay_mesh(ground, image, where, self._lost_tints if lost else self._tints)
        if points is not None and self.style.skeleton:
            size = self._view.fx / max(float(points[:, 2].mean()), 0.05) / PIXELS_PER_METRE
            draw_skeleton(ground, self._view.project(points), size=size, faded=lost)
        if self.style.text:
            draw_lines(ground, lines)
        if not self.style.side_by_side:
            return ground
        plain = self._enlarge(colour_depth(image, *self._range))
        if self.style.text and title:
            draw_lines(plain, [(title, INK)])
        return np.hstack([plain, ground])

    def cut(self) -> None:
        """The next picture is not of the same take: view and colours need not follow."""
        self._range = self._centre = None

    def _follow(self, depth: NDArray[np.float32], points: NDArray[np.float64] | None) -> None:
        """Aim view and colours at the hand, smoothly."""
        if points is not None:
            # The palm moves less than the fingers, so the view stays calmer.
            middle = 0.5 * (palm_centre(points) + points.mean(0))
            self._centre = followed(self._centre, middle)
        if self._centre is not None:
            self._range = depth_range(depth, float(self._centre[2]))
        elif self._range is None:
            self._range = depth_range(depth)
        if self.style.zoom is not None and self._centre is not None and self._centre[2] > 0:
            self._view = _zoomed(self.camera, self.style.panel, self._centre, self.style.zoom)

    def _enlarge(self, picture: Image) -> Image:
        """A picture of the whole image as the view shows it."""
        return _resample(picture, self.camera, self._view, EMPTY_COLOUR)

    def _lay_mesh(
        self,
        ground: Image,
        depth: NDArray[np.float32],
        pose: NDArray[np.float64],
        tints: NDArray[np.float64],
    ) -> None:
        """Blend the lit mesh over a picture of the view."""
        style, factor = self.style, self.style.supersample
        fine = _finer(self._view, factor)
        self._renderer.aim(fine)
        mesh = shade_mesh(self._renderer, pose, tints, self._fade)
        rows, columns = np.flatnonzero(mesh.depth.any(1)), np.flatnonzero(mesh.depth.any(0))
        if not len(rows):
            return
        # The picture's pixels that the mesh touches, and the fine ones that make them up.
        box = tuple(slice(int(n[0]) // factor, int(n[-1]) // factor + 1) for n in (rows, columns))
        inner = tuple(slice(n.start * factor, n.stop * factor) for n in box)
        surface = mesh.depth[inner]
        measured = _resample(depth, self.camera, fine, 0.0)[inner]
        before = (measured > 0) & (measured < surface - style.hidden_margin)
        # Single pixels before the mesh are noise, not things.
        reach = max(3, round(2.5 * fine.fx / self.camera.fx))
        before = cv2.morphologyEx(
            before.astype(np.uint8), cv2.MORPH_OPEN, np.ones((reach, reach), np.uint8)
        )
        opacity = np.where(before > 0, style.hidden_opacity, style.mesh_opacity)
        opacity = (opacity * mesh.opacity[inner]).astype(np.float32)[..., None]
        size = (box[1].stop - box[1].start, box[0].stop - box[0].start)
        # Colours are averaged with their opacity, so outlines stay clean.
        colour = cv2.resize(mesh.picture[inner] * opacity, size, interpolation=cv2.INTER_AREA)
        cover = cv2.resize(opacity, size, interpolation=cv2.INTER_AREA)[..., None]
        ground[box] = np.rint(ground[box] * (1.0 - cover) + colour).astype(np.uint8)


def check_panel(panel: tuple[int, int]) -> None:
    """Check width and height of a panel [pixels].

    Raises:
        InputError: A side is too short or too long.
    """
    if min(panel) < 64 or max(panel) > 4096:
        raise InputError(f"panel is {panel}: expected sides of 64 to 4096 pixels")


def drawable_pose(pose: ArrayLike | None) -> NDArray[np.float64] | None:
    """A pose as an array, shape (28,); None where there is none, or it is not finite.

    Raises:
        InputError: The pose has the wrong shape.
    """
    if pose is None:
        return None
    where = np.asarray(pose, np.float64)
    if where.shape != (NQ,):
        raise InputError(f"pose has shape {where.shape}: expected ({NQ},)")
    return where if np.isfinite(where).all() else None


def followed(past: NDArray[np.float64] | None, middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The centre of a view that moves after the hand gently, as a video needs it [m].

    Args:
        past: Where the centre was in the picture before, shape (3,); None at the start of a take.
        middle: Where the hand is, shape (3,).
    """
    return middle if past is None else past + _FOLLOW * (middle - past)


def draw_skeleton(
    picture: Image, pixels: NDArray[np.floating], *, size: float = 1.0, faded: bool = False
) -> None:
    """Draw bones and keypoints, coloured by finger.

    Args:
        picture: Picture to draw into, uint8, channels B G R.
        pixels: The 21 keypoints in pixels, shape (21, 2); those that are not finite are left out.
        size: Thickness of lines and dots, 1 for a hand of about 270 pixels.
        faded: Draw everything in grey.
    """
    size = min(max(size, 0.5), 4.0)
    line, dot = max(1, round(2 * size)), 3.6 * size
    places = _subpixels(pixels, picture)
    for finger in range(len(FINGERS)):
        chain = [0, *range(1 + 4 * finger, 5 + 4 * finger)]
        colour = (150, 150, 150) if faded else FINGER_COLOURS[finger]
        for a, b in pairwise(chain):
            start, end = places[a], places[b]
            if start is not None and end is not None:
                for width, ink in ((line + 2, (25, 25, 25)), (line, colour)):
                    cv2.line(picture, start, end, ink, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    for k in (*range(1, NKEYPOINT), 0):
        place = places[k]
        if place is None:
            continue
        colour = WRIST_COLOUR if k == 0 else FINGER_COLOURS[(k - 1) // 4]
        if faded:
            colour = (170, 170, 170)
        for radius, ink in ((dot + 1.2, (25, 25, 25)), (dot, colour)):
            radius = round(radius * (1 << _SUBPIXEL_BITS))
            cv2.circle(picture, place, radius, ink, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_lines(picture: Image, lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines of text into the upper left corner, dark behind so that they can be read.

    Args:
        picture: Picture to draw into, uint8, channels B G R.
        lines: Text and colour, B G R, of each line.
    """
    size = 0.52 * max(0.7, min(picture.shape[:2]) / 480)
    for row, (text, colour) in enumerate(lines):
        left, base = round(24 * size), round((46 + 42 * row) * size)
        # A thicker stroke of some OpenCV fonts is wider too, so the ground is the text moved about.
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1), (2, 2)):
            place = (left + dx, base + dy)
            cv2.putText(picture, text, place, _FONT, size, (20, 20, 20), 1, cv2.LINE_AA)
        cv2.putText(picture, text, (left, base), _FONT, size, colour, 1, cv2.LINE_AA)


def contact_sheet(pictures: Sequence[Image], columns: int, *, gap: int = 4) -> Image:
    """Put pictures of one size into rows, such as frames of a video for a document.

    Raises:
        InputError: There is no picture, or sizes differ.
    """
    if not pictures or columns < 1:
        raise InputError(f"got {len(pictures)} pictures and {columns} columns: expected some")
    if len({picture.shape for picture in pictures}) > 1:
        raise InputError("pictures of a contact sheet differ in size")
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    shape = (rows * height + (rows - 1) * gap, columns * width + (columns - 1) * gap, 3)
    sheet = np.full(shape, 255, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + gap), (number % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def _fit_view(camera: Camera, panel: tuple[int, int]) -> Camera:
    """Camera of a panel that shows the whole image, centred."""
    width, height = panel
    scale = min(width / camera.width, height / camera.height)
    left = 0.5 * (camera.width - width / scale) - 0.5
    top = 0.5 * (camera.height - height / scale) - 0.5
    return _window(camera, panel, left, top, scale)


def _zoomed(
    camera: Camera, panel: tuple[int, int], centre: NDArray[np.float64], span: float
) -> Camera:
    """Camera of a panel that shows `span` metres around a point."""
    scale = panel[0] * centre[2] / (span * camera.fx)
    u, v = camera.project(centre)
    return _window(
        camera, panel, u - 0.5 * panel[0] / scale, v - 0.5 * panel[1] / scale, float(scale)
    )


def _window(
    camera: Camera, panel: tuple[int, int], left: float, top: float, scale: float
) -> Camera:
    """Camera of the window whose left upper corner (not pixel centre) is given, enlarged."""
    return Camera(
        width=panel[0], height=panel[1], fx=camera.fx * scale, fy=camera.fy * scale,
        cx=(camera.cx - left) * scale - 0.5, cy=(camera.cy - top) * scale - 0.5,
    )  # fmt: skip


def _finer(view: Camera, factor: int) -> Camera:
    """The same view with more pixels."""
    return view.resize(view.width * factor, view.height * factor)


def _resample(image: NDArray[Any], camera: Camera, view: Camera, outside: Any) -> NDArray[Any]:
    """The camera's nearest pixel for each pixel of a view; a value for what lies outside."""
    across, down = camera.fx / view.fx, camera.fy / view.fy
    # View pixel u' shows image pixel (u' - cx') fx / fx' + cx.
    matrix = np.array(
        [[across, 0, camera.cx - view.cx * across], [0, down, camera.cy - view.cy * down]]
    )
    return cv2.warpAffine(
        image, matrix, (view.width, view.height),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT, borderValue=outside,
    )  # fmt: skip


def _subpixels(pixels: NDArray[np.floating], picture: Image) -> list[tuple[int, int] | None]:
    """Fixed-point pixels for OpenCV, kept within what its integers hold; None if not finite."""
    reach = 4.0 * max(picture.shape[:2])
    known: list[bool] = np.asarray(np.isfinite(pixels).all(axis=1)).tolist()
    places = np.rint(np.clip(np.nan_to_num(pixels), -reach, reach) * (1 << _SUBPIXEL_BITS))
    return [
        (u, v) if ok else None
        for (u, v), ok in zip(places.astype(int).tolist(), known, strict=True)
    ]


def _shorten(text: str, length: int) -> str:
    """The beginning of a text, with an ellipsis when it is cut."""
    return text if len(text) <= length else text[: length - 3].rstrip() + "..."
