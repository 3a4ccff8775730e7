"""Pictures of curves, drawn with OpenCV: success rate over threshold, error over time.

The same few lines of drawing serve every curve picture, so no plotting library is needed at run
time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.errors import InputError
from handtrack.evaluation.metrics import success_curve

Image = NDArray[np.uint8]
Range = tuple[float, float]

# Okabe and Ito's colours: distinct for colour-blind readers too. B G R.
_COLOURS: tuple[tuple[int, int, int], ...] = (
    (178, 114, 0), (0, 94, 213), (115, 158, 0), (167, 121, 204), (0, 159, 230), (233, 180, 86),
    (60, 60, 60),
)  # fmt: skip
_INK = (60, 60, 60)
_FRAME = (150, 150, 150)
_GRID = (232, 232, 232)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LEFT, _RIGHT, _TOP, _BOTTOM = 84, 28, 56, 66
_SUBPIXEL_BITS = 4


def draw_curves(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    xlabel: str,
    ylabel: str,
    title: str,
    *,
    size: tuple[int, int] = (880, 560),
    x_range: Range | None = None,
    y_range: Range | None = None,
) -> Image:
    """Draw curves with axes, ticks, grid and legend.

    Args:
        curves: Legend text -> x and y, each of shape (n,); gaps where either is not finite.
        xlabel: Text under the x axis, with its unit.
        ylabel: Text beside the y axis, with its unit.
        title: Text above.
        size: Width and height of the picture [pixels].
        x_range: Ends of the x axis; from the data without.
        y_range: Ends of the y axis; from the data, opened to round numbers, without.

    Returns:
        Picture, shape (height, width, 3), uint8, channels B G R as `cv2.imwrite` expects.
    """
    data = {name: _curve(name, *xy) for name, xy in curves.items()}
    if not data:
        raise InputError("there are no curves to draw")
    width, height = size
    if width < 320 or height < 240:
        raise InputError(
            f"a curve picture of {width} x {height} pixels is too small: 320 x 240 at least"
        )
    x_range = x_range or _data_range([x for x, _ in data.values()], widen=False)
    y_range = y_range or _data_range([y for _, y in data.values()], widen=True)

    image = np.full((height, width, 3), 255, np.uint8)
    box = image[_TOP : height - _BOTTOM, _LEFT : width - _RIGHT]
    _draw_axes(image, box.shape[1], box.shape[0], x_range, y_range)
    pixels = [_to_pixels(x, y, x_range, y_range, box.shape) for x, y in data.values()]
    for points, colour in zip(reversed(pixels), reversed(_colours(len(pixels))), strict=True):
        _draw_line(box, points, colour)
    cv2.rectangle(image, (_LEFT, _TOP), (width - _RIGHT, height - _BOTTOM), _FRAME, 1)
    _draw_legend(box, list(data), pixels)
    _text(image, title, (_LEFT, 34), 0.62)
    _text(image, xlabel, ((_LEFT + width - _RIGHT) // 2, height - 18), 0.52, align="centre")
    _vertical_text(image, ylabel, 12, (_TOP + height - _BOTTOM) // 2)
    return image


def draw_success_curves(
    errors_mm: Mapping[str, ArrayLike],
    *,
    title: str = "Frames whose worst joint is within a distance",
    limit_mm: float = 80.0,
) -> Image:
    """Draw the success rate over the threshold.

    Args:
        errors_mm: Legend text -> errors [mm], shape (n, njoint).
        title: Text above.
        limit_mm: Right end of the axis [mm].
    """
    thresholds = np.linspace(0.0, limit_mm, 401)
    curves = {
        name: (thresholds, 100.0 * success_curve(e, thresholds)) for name, e in errors_mm.items()
    }
    return draw_curves(
        curves,
        "distance [mm]",
        "share of frames [%]",
        title,
        x_range=(0.0, limit_mm),
        y_range=(0.0, 100.0),
    )


def draw_errors_over_time(
    errors_mm: Mapping[str, ArrayLike],
    *,
    title: str = "Mean joint error of each frame",
    frames: ArrayLike | None = None,
) -> Image:
    """Draw the mean joint error of every frame.

    Args:
        errors_mm: Legend text -> errors [mm], shape (n, njoint) or, one number a frame, (n,).
        title: Text above.
        frames: Frame numbers, shape (n,), where all curves share them; 0, 1, 2, ... without.
    """
    curves = {}
    for name, errors in errors_mm.items():
        errors = np.asarray(errors, dtype=np.float64)
        means = errors if errors.ndim == 1 else errors.mean(axis=1)
        curves[name] = (np.arange(len(means)) if frames is None else frames, means)
    top = max(float(np.nanmax(y)) for _, y in curves.values())
    return draw_curves(
        curves, "frame", "mean joint error [mm]", title, y_range=(0.0, _ceil(1.05 * top))
    )


def write_picture(path: str | Path, image: Image) -> None:
    """Write a picture, channels B G R, in the format its suffix names.

    Raises:
        InputError: The suffix is unknown or the file cannot be written.
    """
    try:
        written = cv2.imwrite(str(path), image)
    except cv2.error:
        written = False
    if not written:
        raise InputError(f"cannot write a picture to {path}: use a folder that exists and .png")


def _curve(
    name: str, x: ArrayLike, y: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both coordinates in float64 after checking that they belong together."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or not x.size:
        raise InputError(
            f"curve {name!r} has x of shape {x.shape} and y of shape {y.shape}: expected (n,) both"
        )
    if not (np.isfinite(x) & np.isfinite(y)).any():
        raise InputError(f"curve {name!r} has no finite point")
    return x, y


def _data_range(values: Sequence[NDArray[np.float64]], *, widen: bool) -> Range:
    """Smallest and largest finite value, never the same; opened to round numbers if asked."""
    joined = np.concatenate(values)
    joined = joined[np.isfinite(joined)]
    low, high = float(joined.min()), float(joined.max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    if widen:
        step = _tick_step(high - low, 6)
        low, high = step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)
    return low, high


def _ceil(value: float) -> float:
    """Next round number at or above a value, at least 1e-3."""
    step = _tick_step(max(value, 1e-3), 6)
    return step * math.ceil(value / step - 1e-9) or step


def _tick_step(span: float, count: int) -> float:
    """Distance of ticks, 1, 2 or 5 times a power of ten, for about so many ticks over the span."""
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(math.log(raw / (power * m))))


def _ticks(ends: Range, count: int) -> list[float]:
    """Round numbers within an axis."""
    low, high = ends
    step = _tick_step(high - low, count)
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    return [step * k for k in range(first, last + 1)]


def _draw_axes(image: Image, width: int, height: int, x_range: Range, y_range: Range) -> None:
    """Grid lines, ticks and their numbers around the plot box of a size [pixels]."""
    for value in _ticks(x_range, max(3, width // 95)):
        u = _LEFT + round((value - x_range[0]) / (x_range[1] - x_range[0]) * width)
        cv2.line(image, (u, _TOP), (u, _TOP + height), _GRID, 1)
        cv2.line(image, (u, _TOP + height), (u, _TOP + height + 4), _FRAME, 1)
        _text(image, f"{value:.6g}", (u, _TOP + height + 21), 0.45, align="centre")
    for value in _ticks(y_range, max(3, height // 65)):
        v = _TOP + round((y_range[1] - value) / (y_range[1] - y_range[0]) * height)
        cv2.line(image, (_LEFT, v), (_LEFT + width, v), _GRID, 1)
        cv2.line(image, (_LEFT - 4, v), (_LEFT, v), _FRAME, 1)
        _text(image, f"{value:.6g}", (_LEFT - 9, v + 5), 0.45, align="right")


def _to_pixels(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    x_range: Range,
    y_range: Range,
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    """Curve in pixels of the plot box, shape (n, 2); NaN at gaps."""
    u = (x - x_range[0]) / (x_range[1] - x_range[0]) * shape[1]
    v = (y_range[1] - y) / (y_range[1] - y_range[0]) * shape[0]
    points = np.stack([u, v], axis=-1)
    points[~np.isfinite(points).all(axis=1)] = np.nan
    # Points far outside would overflow OpenCV's fixed-point coordinates.
    return np.clip(points, -1e4, 1e4)


def _draw_line(box: Image, points: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    """Draw one curve into the plot box, a single line per stretch without gaps."""
    finite = np.isfinite(points[:, 0])
    for part in np.split(np.arange(len(points)), np.flatnonzero(np.diff(finite)) + 1):
        if finite[part[0]]:
            fixed = np.round(points[part] * 2**_SUBPIXEL_BITS).astype(np.int32)
            thickness = 2 if len(part) < 1500 else 1
            cv2.polylines(box, [fixed], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_legend(box: Image, names: list[str], pixels: list[NDArray[np.float64]]) -> None:
    """Draw the legend in the corner of the plot box that hides the fewest curve points."""
    scale, line = 0.46, 22
    width = 52 + max(cv2.getTextSize(name, _FONT, scale, 1)[0][0] for name in names)
    height = 12 + line * len(names)
    rows, columns = box.shape[:2]
    points = np.concatenate(pixels)

    def hidden(corner: tuple[int, int]) -> int:
        u, v = points[:, 0] - corner[0], points[:, 1] - corner[1]
        return int(np.count_nonzero((u > -8) & (u < width + 8) & (v > -8) & (v < height + 8)))

    right, bottom = columns - width - 12, rows - height - 12
    left, top = min(((right, bottom), (right, 12), (12, 12), (12, bottom)), key=hidden)
    left, top = max(left, 0), max(top, 0)
    patch = box[top : top + height, left : left + width]
    patch[:] = (0.12 * patch + 0.88 * 255.0).astype(np.uint8)
    cv2.rectangle(box, (left, top), (left + width, top + height), _GRID, 1)
    for k, (name, colour) in enumerate(zip(names, _colours(len(names)), strict=True)):
        v = top + 6 + line // 2 + k * line
        cv2.line(box, (left + 9, v), (left + 33, v), colour, 2, cv2.LINE_AA)
        _text(box, name, (left + 42, v + 5), scale)


def _colours(count: int) -> list[tuple[int, int, int]]:
    """Colours of so many curves."""
    return [_COLOURS[k % len(_COLOURS)] for k in range(count)]


def _text(
    image: Image, text: str, at: tuple[int, int], scale: float, *, align: str = "left"
) -> None:
    """Write text with its base line at a pixel."""
    width = cv2.getTextSize(text, _FONT, scale, 1)[0][0]
    shift = {"left": 0, "centre": width // 2, "right": width}[align]
    cv2.putText(image, text, (at[0] - shift, at[1]), _FONT, scale, _INK, 1, cv2.LINE_AA)


def _vertical_text(image: Image, text: str, left: int, middle: int) -> None:
    """Write text upwards, centred on a row."""
    (width, height), base = cv2.getTextSize(text, _FONT, 0.52, 1)
    strip = np.full((height + base + 4, width + 4, 3), 255, np.uint8)
    _text(strip, text, (2, height + 2), 0.52)
    strip = cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE)
    top = max(0, middle - strip.shape[0] // 2)
    strip = strip[: image.shape[0] - top]
    image[top : top + strip.shape[0], left : left + strip.shape[1]] = strip
