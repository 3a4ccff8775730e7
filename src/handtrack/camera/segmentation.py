"""Where a hand may be in a depth image, without any distance set by the user.

A frame is cut where neighbouring depths jump. Each piece that is larger than a hand (an arm, a
whole person) is searched for its extremities: the points farthest along the surface from its middle
(Plagemann et al., "Real-time identification and localization of body parts from depth images", ICRA
2010). What lies within a hand's length of an extremity, or is a hand-sized piece of its own, is a
region, judged by nearness, size, how narrow its link to the rest is, whether it leaves the image,
and how far its outline is from a smooth one, for fingers make a long outline. This stage is for
frames without a previous result; `region_around` is for all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.geodesic import SurfaceGraph
from handtrack.errors import InputError

JUMP = 0.025
"""Depth step between neighbours that separates two surfaces [m]."""
HAND_LENGTH = 0.19
"""Wrist to fingertip of an adult [m]; also what is kept inward from an extremity."""
PALM_REACH = 0.12
"""What is kept around a point that may be the middle of a palm [m]."""
MIN_AREA = 12e-4
"""Smallest surface seen of a hand [m^2]: a child's fist, about 4 cm by 3 cm."""
FULL_AREA = (30e-4, 220e-4)
"""Usual surface seen of a hand [m^2]: an adult's fist to a spread hand with some wrist."""
WRIST_WIDTH = 0.09
"""Widest link between a hand and its arm that costs no score [m]."""
ARM_OUTLINE, FINGER_OUTLINE = 1.5, 2.5
"""Outline squared over 4 pi area of a smooth stub, and from which on it speaks for fingers."""
NEARNESS = 0.3
"""Each so much farther than the nearest surface divides the score by e [m]."""
SEARCH_SIDE = 160
"""The image is thinned out to at most this many pixels a side for the search."""
RADIUS = (0.09, 0.14)
"""Smallest and largest radius of a region [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HandRegion:
    """A ball that may hold a hand."""

    centre: NDArray[np.float64]
    """Centre [m], shape (3,), camera frame."""
    radius: float
    """Radius of the ball [m]."""
    box: tuple[int, int, int, int]
    """Pixels that can see the ball: left, top, right, bottom (exclusive), inside the image."""
    score: float = 1.0
    """How plausible it is that a hand is here, 0 to 1."""
    area: float = 0.0
    """Surface seen in it [m^2]."""
    point_count: int = 0
    """Measured pixels that belong to it, at full resolution."""
    wrist: NDArray[np.float64] | None = None
    """Where it joins an arm [m], shape (3,), camera frame, None if it stands alone."""


def find_hand_regions(
    depth: NDArray[np.float32], camera: Camera, *, max_regions: int = 5
) -> list[HandRegion]:
    """Propose where hands may be, the most plausible first.

    Args:
        depth: Depth [m], shape (height, width), as `check_depth` returns it.
        camera: Intrinsics of the image.
        max_regions: How many regions to return at most.

    Returns:
        Regions by falling score; empty if nothing in the image has the size of a hand.
    """
    step = -(-max(camera.shape) // SEARCH_SIDE)
    small = camera.thin(step)
    points = small.points(depth[::step, ::step])
    z = points[..., 2]
    pixel_area = (z / small.fx) * (z / small.fy)

    _, labels = cv2.connectedComponents(_surfaces(z, camera=small), connectivity=4)
    areas = np.bincount(labels.ravel(), weights=pixel_area.ravel())
    pieces = 1 + np.flatnonzero(areas[1:] >= MIN_AREA)
    if pieces.size == 0:
        return []
    fronts = [float(np.percentile(z[labels == piece], 5)) for piece in pieces]
    nearest = min(fronts)

    found: list[HandRegion] = []
    for piece, front in zip(pieces, fronts, strict=True):
        if front > nearest + 4.0 * NEARNESS:
            continue
        graph = SurfaceGraph(points, labels == piece)
        for member in _hand_sized_parts(graph):
            region = _region(member, graph, pixel_area, nearest, camera, step)
            if region is not None:
                found.append(region)
    return _without_doubles(sorted(found, key=lambda region: -region.score))[:max_regions]


def centres_of(regions: list[HandRegion]) -> NDArray[np.float64]:
    """Middles of regions [m], shape (n, 3)."""
    return np.array([region.centre for region in regions]).reshape(-1, 3)


def wrists_of(regions: list[HandRegion]) -> NDArray[np.float64]:
    """Where regions join an arm [m], NaN where they stand alone, shape (n, 3)."""
    nowhere = np.full(3, np.nan)
    return np.array([
        nowhere if region.wrist is None else region.wrist for region in regions
    ]).reshape(-1, 3)  # fmt: skip


def region_around(keypoints: ArrayLike, camera: Camera, *, margin: float = 0.04) -> HandRegion:
    """The ball around a hand that was found before, where its next frame is looked for.

    Args:
        keypoints: Keypoints [m], shape (n, 3), camera frame.
        camera: Intrinsics of the image.
        margin: Added to the radius for the hand's flesh and its motion until then [m].
    """
    points = np.asarray(keypoints, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(f"keypoints have shape {points.shape}: expected finite (n, 3) metres")
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max()) + margin
    return HandRegion(centre=centre, radius=radius, box=ball_box(centre, radius, camera))


def keep_region(
    depth: NDArray[np.float32],
    camera: Camera,
    region: HandRegion,
    *,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Depth of the pixels inside a region's ball, 0 elsewhere.

    Args:
        depth: Depth [m], shape (height, width).
        camera: Intrinsics of the image.
        region: The ball.
        out: Where to write, same shape; allocated if None.

    Returns:
        Depth [m], shape (height, width).
    """
    out = np.empty_like(depth) if out is None else out
    out.fill(0.0)
    left, top, right, bottom = region.box
    if right <= left or bottom <= top:
        return out
    window = depth[top:bottom, left:right]
    points = camera.crop(left, top, right - left, bottom - top).points(window)
    points -= region.centre.astype(np.float32)
    inside = np.einsum("hwc,hwc->hw", points, points) <= region.radius**2
    np.copyto(out[top:bottom, left:right], window, where=inside & (window > 0))
    return out


def ball_box(centre: ArrayLike, radius: float, camera: Camera) -> tuple[int, int, int, int]:
    """Pixels that can see a ball: left, top, right, bottom (exclusive), inside the image.

    Args:
        centre: Centre [m], shape (3,), camera frame.
        radius: Radius [m].
        camera: Intrinsics of the image.
    """
    x, y, z = (float(value) for value in np.asarray(centre, np.float64))
    left, right = _shadow(x, z, radius, camera.fx, camera.cx, camera.width)
    top, bottom = _shadow(y, z, radius, camera.fy, camera.cy, camera.height)
    return left, top, right, bottom


def _shadow(
    x: float, z: float, radius: float, focal: float, middle: float, size: int
) -> tuple[int, int]:
    """First and last-but-one pixel, along one image axis, that a ball covers."""
    distance = np.hypot(x, z)
    if distance <= radius:  # the camera is inside
        return 0, size
    # The tangents from the camera to the ball's circle in this plane.
    direction, half = np.arctan2(x, z), np.arcsin(radius / distance)
    limit = np.pi / 2 - 1e-3
    low, high = (np.tan(np.clip(direction + turn, -limit, limit)) for turn in (-half, half))
    first = int(np.clip(np.floor(middle + focal * low), 0, size))
    last = int(np.clip(np.ceil(middle + focal * high) + 1, 0, size))
    return first, max(first, last)


def _surfaces(z: NDArray[np.float32], *, camera: Camera) -> NDArray[np.uint8]:
    """Mask of measured pixels that falls apart where depth jumps: the farther side is left out."""
    # Thinned-out pixels are farther apart, so a slanted surface may step more between them.
    allowed = np.maximum(JUMP, 4.0 * z / min(camera.fx, camera.fy))
    mask = z > 0
    for axis in (0, 1):
        ahead = np.roll(z, -1, axis)
        rise = ahead - z
        inner = np.ones_like(mask)
        inner[(-1, slice(None)) if axis == 0 else (slice(None), -1)] = False
        measured = inner & (z > 0) & (ahead > 0)
        mask &= ~(measured & (-rise > allowed))
        mask &= ~np.roll(measured & (rise > allowed), 1, axis)
    return mask.astype(np.uint8)


def _hand_sized_parts(graph: SurfaceGraph) -> list[NDArray[np.bool_]]:
    """Parts of a surface that could be a hand, as masks over its nodes."""
    middle = graph.distances([graph.central_node()])
    tips: list[int] = [int(np.argmax(middle))]
    across = graph.distances(tips)
    if across.max() <= 1.25 * HAND_LENGTH or graph.extent() <= 0.6 * HAND_LENGTH:
        return [np.ones(graph.node_count, bool)]
    parts = [across <= HAND_LENGTH]
    reached = np.minimum(middle, across)
    for _ in range(7):
        tip = int(np.argmax(reached))
        if reached[tip] < 0.6 * HAND_LENGTH:
            break
        distance = graph.distances([tip])
        parts.append(distance <= HAND_LENGTH)
        reached = np.minimum(reached, distance)
    parts.append(graph.distances([graph.nearest_node()]) <= PALM_REACH)
    return parts


def _region(
    member: NDArray[np.bool_],
    graph: SurfaceGraph,
    pixel_area: NDArray[np.floating],
    nearest: float,
    camera: Camera,
    step: int,
) -> HandRegion | None:
    """Measure and judge one part of a surface."""
    rows, columns = graph.rows[member], graph.columns[member]
    area = float(pixel_area[rows, columns].sum())
    if area < MIN_AREA:
        return None
    points = graph.points[member]
    centre = points.mean(axis=0)
    extent = float(np.percentile(np.linalg.norm(points - centre, axis=1), 98))
    radius = float(np.clip(extent + 0.02, *RADIUS))

    link_width, link = graph.link(member)
    height, width = pixel_area.shape
    edge = (rows == 0) | (rows == height - 1) | (columns == 0) | (columns == width - 1)
    pixel_width = np.sqrt(pixel_area[rows, columns])
    border = float((edge * pixel_width).sum())
    outline = graph.outline(member) * float(pixel_width.mean())
    roundness = outline**2 / (4.0 * np.pi * area)

    small, full = FULL_AREA
    size = min(1.0, area / small) * min(1.0, (full / area) ** 2)
    size *= (HAND_LENGTH / 2 / max(extent, HAND_LENGTH / 2)) ** 2
    nearness = np.exp(-max(0.0, float(np.percentile(points[:, 2], 5)) - nearest) / NEARNESS)
    narrow = np.exp(-max(0.0, link_width + border - WRIST_WIDTH) / 0.06)
    fingers = np.interp(roundness, [ARM_OUTLINE, FINGER_OUTLINE], [0.6, 1.0])
    return HandRegion(
        centre=centre,
        radius=radius,
        box=ball_box(centre, radius, camera),
        score=float(size * nearness * narrow * fingers),
        area=area,
        point_count=int(member.sum()) * step * step,
        wrist=link,
    )


def _without_doubles(regions: list[HandRegion]) -> list[HandRegion]:
    """Regions that do not mostly cover a better one."""
    kept: list[HandRegion] = []
    for region in regions:
        if all(np.linalg.norm(region.centre - other.centre) > 0.06 for other in kept):
            kept.append(region)
    return kept
