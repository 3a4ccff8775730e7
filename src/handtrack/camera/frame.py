"""Depth frames, and the check that every depth image passes before it is tracked.

Depth is z in metres, float32, row 0 at the top; 0 means no measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera

MAX_DEPTH = 20.0
"""Depth beyond which a pixel counts as unmeasured [m]; also catches millimetres given as metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTruth:
    """What is known of the hand in a frame; every part is optional."""

    keypoints: NDArray[np.float32] | None = None
    """The 21 keypoints [m], shape (21, 3), camera frame, in the order of docs/conventions.md."""
    pose: NDArray[np.float64] | None = None
    """Pose vector, shape (28,): translation [m], unit quaternion w x y z, angles [rad]."""
    joints: NDArray[np.float32] | None = None
    """The data set's own joints [m], shape (njoint, 3), camera frame, NaN where not labelled."""
    joint_set: str = ""
    """Name of the set `joints` follows, such as "nyu36" (docs/formats.md)."""
    side: str | None = None
    """"right" or "left", None when it is not told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFrame:
    """One depth image with its camera and time."""

    depth: NDArray[np.float32]
    """Depth along the optical axis [m], shape (height, width), C order, 0 = no measurement."""
    camera: Camera
    """Intrinsics of this image."""
    time: float = 0.0
    """Time stamp [s], on the sequence's own clock."""
    index: int = 0
    """Number of the frame in its sequence, from 0."""
    name: str = ""
    """File name or label of the frame."""
    truth: FrameTruth | None = None
    """Labels, None when there are none."""
    received: float | None = None
    """When a live frame arrived here [s], by `time.perf_counter`; None in a recording."""
    problem: str | None = None
    """Why this frame could not be read (`depth` is all zero then), None for a good frame."""


def check_depth(
    depth: Any, camera: Camera, *, out: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], str | None]:
    """Turn whatever a caller passes as a depth image into a clean one. Never raises.

    Pixels that are NaN, infinite, negative or beyond `MAX_DEPTH` become 0. An image that cannot be
    used at all (wrong size, not numeric, integers of unknown unit, no measurement) gives an
    all-zero image and a sentence that says why.

    Args:
        depth: Depth image [m], shape (height, width) of the camera, any float type and strides.
        camera: Camera the image must belong to.
        out: Where to write the clean image, float32, shape (height, width); allocated if None.

    Returns:
        The clean image [m], shape (height, width), C order, never the caller's own array, and
        the problem with it or None.
    """
    if out is None:
        out = np.empty(camera.shape, np.float32)
    if not isinstance(depth, np.ndarray):
        try:
            depth = np.asarray(depth)
        except Exception as error:  # ragged lists, device tensors, anything at all
            return _nothing(out, f"depth is a {type(depth).__name__}, not an image ({error})")
    problem = _unusable(depth, camera)
    if problem is not None:
        return _nothing(out, problem)

    if isinstance(depth, np.ma.MaskedArray):
        depth = depth.filled(0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        np.copyto(out, depth, casting="same_kind")
        # NaN makes both comparisons false, so a good image needs two passes and no mask.
        low, high = out.min(), out.max()
        if not (low >= 0.0 and high <= MAX_DEPTH):
            good = out > 0.0
            np.logical_and(good, out <= MAX_DEPTH, out=good)
            np.copyto(out, np.float32(0.0), where=~good)
            high = out.max()
    if high <= 0.0:
        return out, f"depth holds no measurement between 0 and {MAX_DEPTH:g} m"
    return out, None


def _unusable(depth: NDArray[Any], camera: Camera) -> str | None:
    """Why an array cannot be a depth image of the camera, or None."""
    if depth.shape != camera.shape:
        return f"depth has shape {depth.shape}, its camera {camera.shape} (height, width)"
    if depth.dtype.kind in "iu":
        return (
            f"depth is {depth.dtype} with no unit; multiply by the depth unit first: "
            "depth.astype(np.float32) * 0.001 for millimetres"
        )
    if depth.dtype.kind != "f":
        return f"depth has type {depth.dtype}: expected floating-point metres"
    return None


def _nothing(out: NDArray[np.float32], problem: str) -> tuple[NDArray[np.float32], str]:
    """An image without any measurement, and the reason."""
    out.fill(0.0)
    return out, problem
