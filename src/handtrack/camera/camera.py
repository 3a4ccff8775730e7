"""The pinhole camera: intrinsics, projection and back-projection.

Camera frame: x right, y down, z forward, metres. Integer pixel coordinates are pixel centres, so
the image covers u in [-0.5, width - 0.5] and v in [-0.5, height - 0.5].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError

_FIELDS = ("width", "height", "fx", "fy", "cx", "cy")

MAX_SIDE = 16384
"""Largest image side accepted [pixels]; more is a typing error, not a depth camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of an undistorted depth camera.

    Raises:
        InputError: A value is not finite, a size or focal length is not positive.
    """

    width: int
    """Image width [pixels]."""
    height: int
    """Image height [pixels]."""
    fx: float
    """Focal length along x [pixels]."""
    fy: float
    """Focal length along y [pixels]."""
    cx: float
    """Principal point x [pixels]; integer coordinates are pixel centres."""
    cy: float
    """Principal point y [pixels]."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, _whole(name, getattr(self, name)))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, _finite(name, getattr(self, name)))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0.0:
                raise InputError(
                    f"camera {name} is {getattr(self, name):g}: a focal length is a positive "
                    "number of pixels, about the image width for a usual depth camera"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of this camera's images: (height, width)."""
        return self.height, self.width

    def project(self, points: ArrayLike) -> NDArray[Any]:
        """Pixels at which points appear.

        Args:
            points: Points [m], shape (..., 3), camera frame.

        Returns:
            Pixels u v, shape (..., 2), NaN for points that are not in front of the camera;
            float32 for float32 points, else float64.
        """
        points = _floating(points)
        if points.shape[-1:] != (3,):
            raise InputError(f"points to project have shape {points.shape}: expected (..., 3)")
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        pixels = np.empty((*points.shape[:-1], 2), points.dtype)
        pixels[..., 0] = points[..., 0] / z * self.fx + self.cx
        pixels[..., 1] = points[..., 1] / z * self.fy + self.cy
        return pixels

    def unproject(self, pixels: ArrayLike, z: ArrayLike) -> NDArray[Any]:
        """Points seen at pixels at given depths.

        Args:
            pixels: Pixels u v, shape (..., 2).
            z: Depth along the optical axis [m], shape (...) or one that broadcasts to it.

        Returns:
            Points [m], shape (..., 3), camera frame; float32 if both arguments are, else float64.
        """
        pixels, z = _floating(pixels), _floating(z)
        if pixels.shape[-1:] != (2,):
            raise InputError(f"pixels to unproject have shape {pixels.shape}: expected (..., 2)")
        shape = np.broadcast_shapes(pixels.shape[:-1], z.shape)
        points = np.empty((*shape, 3), np.result_type(pixels, z))
        points[..., 0] = (pixels[..., 0] - self.cx) / self.fx * z
        points[..., 1] = (pixels[..., 1] - self.cy) / self.fy * z
        points[..., 2] = z
        return points

    def points(self, depth: ArrayLike) -> NDArray[np.float32]:
        """Back-project a whole depth image.

        Args:
            depth: Depth [m], shape (height, width), 0 = no measurement.

        Returns:
            Points [m], shape (height, width, 3), camera frame; zero where depth is zero.
        """
        depth = np.asarray(depth, np.float32)
        if depth.shape != self.shape:
            raise InputError(
                f"depth has shape {depth.shape}: expected {self.shape} (height, width) of its "
                "camera; use the camera of that stream, or Camera.resize or Camera.crop"
            )
        points = np.empty((*self.shape, 3), np.float32)
        u = ((np.arange(self.width) - self.cx) / self.fx).astype(np.float32)
        v = ((np.arange(self.height) - self.cy) / self.fy).astype(np.float32)
        np.multiply(depth, u, out=points[..., 0])
        np.multiply(depth, v[:, None], out=points[..., 1])
        points[..., 2] = depth
        return points

    def crop(self, left: int, top: int, width: int, height: int) -> Camera:
        """Camera of the image ``depth[top:top + height, left:left + width]``.

        The window may reach over the image's border, as that of a padded crop does.
        """
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def resize(self, width: int, height: int) -> Camera:
        """Camera of the image resampled to a new size, with the same view.

        Pixel centres are integers, so the left border of the image is at u = -0.5 and stays there:
        u' = (u + 0.5) * width' / width - 0.5. This is the rule of `cv2.resize`. An image
        thinned out as ``depth[::n, ::n]`` follows another rule: see `thin`.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def scaled(self, factor: float) -> Camera:
        """Camera of the image resized by one factor, sides rounded to whole pixels (`resize`)."""
        factor = _finite("scale factor", factor)
        if factor <= 0.0:
            raise InputError(f"scale factor is {factor:g}: expected a positive number")
        return self.resize(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def thin(self, step: int) -> Camera:
        """Camera of ``depth[::step, ::step]``, which keeps pixel (0, 0): u' = u / step."""
        step = _whole("step", step)
        return Camera(
            width=-(-self.width // step),
            height=-(-self.height // step),
            fx=self.fx / step,
            fy=self.fy / step,
            cx=self.cx / step,
            cy=self.cy / step,
        )

    def to_dict(self) -> dict[str, int | float]:
        """Plain values for JSON: width, height, fx, fy, cx, cy."""
        return {name: getattr(self, name) for name in _FIELDS}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Camera:
        """Camera from `to_dict` or the content of a camera.json; other entries are ignored.

        Raises:
            InputError: An entry is missing or unusable.
        """
        if not isinstance(values, Mapping):
            raise InputError(
                f"camera is a {type(values).__name__}: expected a mapping with {', '.join(_FIELDS)}"
            )
        missing = [name for name in _FIELDS if name not in values]
        if missing:
            raise InputError(
                f"camera lacks {', '.join(missing)}: expected {', '.join(_FIELDS)}, got "
                f"{', '.join(map(str, values)) or 'nothing'}"
            )
        return cls(**{name: values[name] for name in _FIELDS})


def _floating(values: ArrayLike) -> NDArray[Any]:
    """Array of floats: float32 stays, everything else becomes float64."""
    array = np.asarray(values)
    return array if array.dtype == np.float32 else array.astype(np.float64)


def _finite(name: str, value: Any) -> float:
    """The value as a finite Python float."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, (str, bool)) or not math.isfinite(number):
        raise InputError(f"camera {name} is {value!r}: expected a finite number")
    return number


def _whole(name: str, value: Any) -> int:
    """The value as a positive Python int."""
    number = _finite(name, value)
    if number != int(number) or not 1 <= number <= MAX_SIDE:
        raise InputError(
            f"camera {name} is {value!r}: expected a whole number of pixels, 1 to {MAX_SIDE}"
        )
    return int(number)
