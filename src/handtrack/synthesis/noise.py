"""Noise of depth cameras: turns a clean rendered depth image into what a sensor would measure.

The steps, in this order: ragged silhouettes, flying pixels, axial noise, quantisation, missing
pixels. Angles are used where papers give pixels of one sensor, so a preset means the same camera at
every image resolution.

Sources, cited by short name below:

* Nguyen 2012: C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D
  reconstruction and tracking", 3DIMPVT 2012 (axial and lateral noise of a PrimeSense sensor over
  distance and slant).
* Khoshelham 2012: K. Khoshelham, S. O. Elberink, "Accuracy and resolution of Kinect depth data for
  indoor mapping applications", Sensors 12(2), 2012 (disparity steps, occlusion shadow).
* Fankhauser 2015: P. Fankhauser et al., "Kinect v2 for mobile robot navigation: evaluation and
  modeling", ICAR 2015 (axial noise of a time-of-flight sensor over distance and slant).
* Belhedi 2012: A. Belhedi et al., "Noise modelling and uncertainty propagation for TOF sensors",
  ECCV workshops 2012 (random error grows with the square of the distance as the returned light
  fades).
* Sarbolandi 2015: H. Sarbolandi, D. Lefloch, A. Kolb, "Kinect range sensing: structured-light
  versus time-of-flight Kinect", CVIU 139, 2015 (flying pixels, missing pixels at edges and on
  slanted surfaces, both kinds of sensor).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import MAX_DEPTH
from handtrack.errors import InputError
from handtrack.synthesis.surface import (
    edge_pixels,
    edge_step,
    farthest_nearby,
    move_silhouettes,
    surface_slant,
)

Depth = NDArray[np.float32]

_SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, kw_only=True, slots=True)
class SensorNoise:
    """Noise of one kind of depth camera; every default is "no noise"."""

    axial_floor: float = 0.0
    """Smallest standard deviation of the depth [m]. Nguyen 2012: 0.0012."""
    axial_growth: float = 0.0
    """Growth of the standard deviation with the squared distance from `axial_reference` [1/m].
    Nguyen 2012: 0.0019."""
    axial_reference: float = 0.0
    """Distance of the smallest deviation [m]. Nguyen 2012: 0.4."""
    slant_gain: float = 0.0
    """Growth with the surface's slant: gain * (z / 1 m)^power * theta^2 / (pi/2 - theta)^2 [m].
    Nguyen 2012: 0.0001."""
    slant_power: float = 0.0
    """Exponent of z in the slant term. Nguyen 2012: -0.5; Fankhauser 2015: 1.5."""
    axial_grain: float = 0.0
    """Size of the noise's grain, the sigma of the Gaussian that smooths it [rad]; its deviation
    stays. Sensors that match windows or filter their output give neighbouring pixels similar errors
    (Sarbolandi 2015)."""
    edge_jitter: float = 0.0
    """Standard deviation of the sideways displacement of silhouettes [rad]. Nguyen 2012: 0.8 pixels
    of 1/585 rad."""
    edge_jitter_slant: float = 0.0
    """Further displacement at slanted surfaces, times theta / (pi/2 - theta) [rad]. Nguyen 2012:
    0.035 pixels."""
    edge_grain: float = 0.0
    """Size of the ripples along silhouettes, the sigma of the Gaussian that smooths the
    displacement [rad]."""
    edge_growth: float = 0.0
    """Standard deviation, from image to image, of the width by which all silhouettes shrink or grow
    [rad]: exposure and the sensor's own filters move the edges of the same object (Sarbolandi
    2015)."""
    flying: float = 0.0
    """Probability that a pixel at a depth edge mixes what is before and behind it [1]. Sarbolandi
    2015."""
    flying_depth: float = 0.0
    """Where nothing was rendered behind an edge, the surface behind is assumed within this distance
    of it [m]."""
    depth_step: float = 0.0
    """Step of the depth [m], of sensors that store it; 0: continuous."""
    inverse_depth_step: float = 0.0
    """Step of the inverse depth [1/m], disparity step over focal length and baseline: depth in
    steps of z^2 times this. Khoshelham 2012: 1/8 pixel, 585 pixels, 0.075 m; 0: continuous."""
    edge_missing: float = 0.0
    """Probability that a pixel at a depth edge has no measurement [1]. Sarbolandi 2015."""
    slant_missing_start: float = math.pi / 2
    """Slant from which pixels begin to miss [rad]."""
    slant_missing_full: float = math.pi / 2
    """Slant beyond which all pixels miss [rad]; noise is that of this slant at most. Nguyen 2012:
    none beyond 82 degrees."""
    dropout: float = 0.0
    """Probability that any pixel has no measurement [1]."""
    shadow_baseline: float = 0.0
    """Place of the projector right of the camera [m], negative: left; what it cannot light is
    missing. 0: none. Khoshelham 2012: 0.075."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            signed = item.name in ("slant_power", "shadow_baseline")
            if not math.isfinite(value) or (value < 0.0 and not signed):
                need = "finite" if signed else "finite and not negative"
                raise InputError(f"SensorNoise.{item.name} is {value}: it must be {need}")
        for name in ("flying", "edge_missing", "dropout"):
            if getattr(self, name) > 1.0:
                raise InputError(
                    f"SensorNoise.{name} is {getattr(self, name)}: a probability is at most 1"
                )
        if not self.slant_missing_start <= self.slant_missing_full <= math.pi / 2:
            raise InputError(
                "SensorNoise.slant_missing_start, slant_missing_full are "
                f"{self.slant_missing_start}, {self.slant_missing_full}: "
                "they must rise and not pass pi/2"
            )

    def axial_deviation(self, depth: ArrayLike, slant: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Standard deviation of a depth measurement before quantisation.

        Args:
            depth: Depth [m], any shape, positive.
            slant: Angle between surface normal and optical axis [rad], same shape or one for all.

        Returns:
            Standard deviation [m], float64.

        Source:
            The form of Nguyen 2012, which that of Fankhauser 2015 has too.
        """
        z = np.asarray(depth, dtype=np.float64)
        theta = np.minimum(
            np.asarray(slant, dtype=np.float64), _below_right(self.slant_missing_full)
        )
        deviation = self.axial_floor + self.axial_growth * (z - self.axial_reference) ** 2
        if self.slant_gain:
            deviation = deviation + (
                self.slant_gain * z**self.slant_power * (theta / (math.pi / 2 - theta)) ** 2
            )
        return np.broadcast_to(deviation, np.broadcast_shapes(z.shape, theta.shape)).copy()

    def apply(self, depth: ArrayLike, camera: Camera, rng: np.random.Generator) -> Depth:
        """Return depth images as the sensor would have measured them.

        Pixels without a surface stay 0, except next to a silhouette, where the noise may move the
        edge outwards.

        Args:
            depth: Clean depth [m], shape (height, width) or (n, height, width); anything that is
                not within 0 to `MAX_DEPTH` counts as nothing there.
            camera: Camera of the images.
            rng: Source of the random numbers; the same state and input give the same output.

        Returns:
            Noisy depth [m], same shape, float32, finite, not negative, 0 where nothing is measured.

        Raises:
            InputError: The images do not have the camera's size.
        """
        with np.errstate(over="ignore"):
            clean = np.array(depth, dtype=np.float32)
        if clean.ndim not in (2, 3) or clean.shape[-2:] != (camera.height, camera.width):
            raise InputError(
                f"depth of shape {clean.shape} does not fit the camera: "
                f"expected {camera.shape} (height, width) or (n, *{camera.shape})"
            )
        with np.errstate(invalid="ignore"):
            clean[~((clean > 0.0) & (clean <= MAX_DEPTH))] = 0.0
        if self != NONE:
            for image in clean.reshape(-1, camera.height, camera.width):
                if image.any():
                    image[:] = self._measure(image, camera, rng)
        return clean

    def _measure(self, depth: Depth, camera: Camera, rng: np.random.Generator) -> Depth:
        """All steps for one image, shape (height, width)."""
        out, slant = self._move_edges(depth, surface_slant(depth, camera), camera, rng)
        shadow = self._shadow(out, camera)
        edges = edge_pixels(out, camera)
        out = self._mix_edges(out, edges, camera, rng)
        out = self._add_axial(out, slant, camera, rng)
        out = self._quantise(out)
        out[shadow | self._missing(out, slant, edges, rng)] = 0.0
        return out

    def _move_edges(
        self, depth: Depth, slant: Depth, camera: Camera, rng: np.random.Generator
    ) -> tuple[Depth, Depth]:
        """Move silhouettes: pixels near an edge take the depth of its other side."""
        if self.edge_growth:
            width = rng.normal(0.0, self.edge_growth * camera.fx)
            depth, slant = move_silhouettes(depth, slant, width, camera, rng)
        if not (self.edge_jitter or self.edge_jitter_slant):
            return depth, slant
        # Empty pixels have no slant of their own: take the steepest one next to them.
        theta = np.minimum(cv2.dilate(slant, _SQUARE), _below_right(self.slant_missing_full))
        sigma = camera.fx * (
            self.edge_jitter + self.edge_jitter_slant * theta / (math.pi / 2 - theta)
        )
        height, width = depth.shape
        shift = [sigma * _grained(rng, depth.shape, self.edge_grain * camera.fx) for _ in range(2)]
        rows, columns = np.mgrid[:height, :width]
        v = np.clip(np.rint(rows + shift[0]), 0, height - 1).astype(np.intp)
        u = np.clip(np.rint(columns + shift[1]), 0, width - 1).astype(np.intp)
        source = depth[v, u]
        # On the same surface a displaced sample would only add to the axial noise, which is
        # modelled apart.
        taken = np.abs(source - depth) > edge_step(np.maximum(source, depth), camera)
        return np.where(taken, source, depth), np.where(taken, slant[v, u], slant)

    def _mix_edges(
        self, depth: Depth, edges: NDArray[np.bool_], camera: Camera, rng: np.random.Generator
    ) -> Depth:
        """Turn pixels at the near side of edges into mixtures of the near and the far surface."""
        if not self.flying:
            return depth
        hit = edges & (rng.random(depth.shape, dtype=np.float32) < self.flying)
        near = depth[hit]
        far = farthest_nearby(depth)[hit]
        guess = near + self.flying_depth * rng.random(near.shape, dtype=np.float32)
        # Zero beside an edge stands for a surface that was not rendered.
        far = np.where(far > near + edge_step(near, camera), far, guess)
        out = depth.copy()
        out[hit] = near + rng.random(near.shape, dtype=np.float32) * (far - near)
        return out

    def _add_axial(
        self, depth: Depth, slant: Depth, camera: Camera, rng: np.random.Generator
    ) -> Depth:
        """Add the depth's random error."""
        if not (self.axial_floor or self.axial_growth or self.slant_gain):
            return depth
        noise = _grained(rng, depth.shape, self.axial_grain * camera.fx)
        seen = depth > 0.0
        out = depth.copy()
        out[seen] += (noise[seen] * self.axial_deviation(depth[seen], slant[seen])).astype(
            np.float32
        )
        return np.maximum(out, 0.0)

    def _quantise(self, depth: Depth) -> Depth:
        """Round to the sensor's steps, of the inverse depth first as the sensor does."""
        out = depth.astype(np.float64)
        seen = out > 0.0
        if self.inverse_depth_step:
            steps = np.maximum(np.rint(1.0 / (out[seen] * self.inverse_depth_step)), 1.0)
            out[seen] = 1.0 / (steps * self.inverse_depth_step)
        if self.depth_step:
            out[seen] = np.rint(out[seen] / self.depth_step) * self.depth_step
        return out.astype(np.float32)

    def _missing(
        self, depth: Depth, slant: Depth, edges: NDArray[np.bool_], rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Pixels that the sensor leaves empty at random: at edges, on steep surfaces, anywhere."""
        ramp = max(self.slant_missing_full - self.slant_missing_start, 1e-6)
        chance = np.clip((slant - self.slant_missing_start) / ramp, 0.0, 1.0)
        chance = 1.0 - (1.0 - chance) * (1.0 - self.dropout) * (1.0 - self.edge_missing * edges)
        return (depth > 0.0) & (rng.random(depth.shape, dtype=np.float32) < chance)

    def _shadow(self, depth: Depth, camera: Camera) -> NDArray[np.bool_]:
        """Pixels that a projector beside the camera cannot light: something nearer is between."""
        if not self.shadow_baseline:
            return np.zeros(depth.shape, bool)
        with np.errstate(divide="ignore"):
            shift = np.where(depth > 0.0, camera.fx * abs(self.shadow_baseline) / depth, -np.inf)
        # With the projector on the left its columns are u + shift, and shadows fall to the right.
        if self.shadow_baseline > 0.0:
            shift = shift[..., ::-1]
        column = np.arange(camera.width) + shift
        before = np.maximum.accumulate(column, axis=-1)
        hidden = (depth if self.shadow_baseline < 0.0 else depth[..., ::-1]) > 0.0
        hidden &= column < before
        return hidden if self.shadow_baseline < 0.0 else hidden[..., ::-1]


def _grained(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Depth:
    """Normal random images of unit deviation, smoothed by a Gaussian of sigma [pixels]."""
    noise = rng.standard_normal(shape, dtype=np.float32)
    if sigma < 0.3:
        return noise
    size = 2 * math.ceil(3.0 * sigma) + 1
    kernel = cv2.getGaussianKernel(size, sigma, cv2.CV_32F)
    noise = cv2.sepFilter2D(noise, -1, kernel, kernel)
    # Smoothing lowers the variance by the kernel's sum of squares along each axis.
    return (noise / np.sum(kernel**2)).astype(np.float32)


def _below_right(angle: float) -> float:
    """The angle, kept so far below pi/2 that the slant terms stay finite."""
    return min(angle, math.radians(89.0))


_PRIMESENSE_PIXEL = 1.0 / 585.0
_SR300_PIXEL = 1.0 / 475.0
_CREATIVE_PIXEL = 1.0 / 241.0
"""Angle of one pixel [rad] of the sensors behind the presets."""

NONE = SensorNoise()
"""No noise at all."""

STRUCTURED_LIGHT = SensorNoise(
    axial_floor=0.0012,
    axial_growth=0.0019,
    axial_reference=0.4,
    slant_gain=0.0001,
    slant_power=-0.5,
    axial_grain=2.0 * _PRIMESENSE_PIXEL,
    edge_jitter=0.8 * _PRIMESENSE_PIXEL,
    edge_jitter_slant=0.035 * _PRIMESENSE_PIXEL,
    edge_grain=1.0 * _PRIMESENSE_PIXEL,
    edge_growth=0.5 * _PRIMESENSE_PIXEL,
    flying=0.03,
    flying_depth=0.05,
    depth_step=0.001,
    inverse_depth_step=0.125 * _PRIMESENSE_PIXEL / 0.075,
    edge_missing=0.15,
    slant_missing_start=math.radians(70.0),
    slant_missing_full=math.radians(82.0),
    dropout=0.002,
    shadow_baseline=0.075,
)
"""PrimeSense-like sensor (Kinect 1, Carmine of the NYU recordings): Nguyen 2012 and Khoshelham
2012.

The grain is set so that a quadratic fitted to 5 x 5 (11 x 11) pixels of a smooth surface at 0.7 m
leaves 0.5 (0.8) mm, as it does on NYU hands (0.5 to 0.7 and 0.6 to 0.9 mm)."""

CODED_LIGHT = SensorNoise(
    axial_floor=0.0003,
    axial_growth=0.0006,
    slant_gain=0.00002,
    slant_power=1.0,
    axial_grain=3.0 * _SR300_PIXEL,
    edge_jitter=0.6 * _SR300_PIXEL,
    edge_grain=1.0 * _SR300_PIXEL,
    edge_growth=0.5 * _SR300_PIXEL,
    flying=0.02,
    flying_depth=0.03,
    depth_step=0.000125,
    edge_missing=0.3,
    slant_missing_start=math.radians(65.0),
    slant_missing_full=math.radians(80.0),
    dropout=0.0005,
    shadow_baseline=0.025,
)
"""Short-range sensor with a sequence of patterns and strong filters of its own (RealSense SR300,
SR305).

The axial level is set so that a quadratic fitted to 5 x 5 (11 x 11) pixels of a smooth surface at
0.6 m leaves 0.05 (0.1) mm, as it does on SR305 recordings of people."""

TIME_OF_FLIGHT = SensorNoise(
    axial_floor=0.0007,
    axial_growth=0.007,
    slant_gain=0.0001,
    slant_power=1.5,
    axial_grain=0.8 * _CREATIVE_PIXEL,
    edge_jitter=0.35 * _CREATIVE_PIXEL,
    edge_grain=1.0 * _CREATIVE_PIXEL,
    edge_growth=0.25 * _CREATIVE_PIXEL,
    flying=0.4,
    flying_depth=0.3,
    depth_step=0.001,
    edge_missing=0.05,
    slant_missing_start=math.radians(76.0),
    slant_missing_full=math.radians(88.0),
    dropout=0.001,
)
"""Short-range time-of-flight sensor (Creative Gesture Camera of the MSRA and ICVL recordings).

Growth with the squared distance after Belhedi 2012, slant after Fankhauser 2015. The level is set
so that a quadratic fitted to 5 x 5 (11 x 11) pixels at 0.3 m leaves 0.7 (1.0) mm, as it does on an
MSRA hand."""

PRESETS: dict[str, SensorNoise] = {
    "none": NONE,
    "structured_light": STRUCTURED_LIGHT,
    "coded_light": CODED_LIGHT,
    "time_of_flight": TIME_OF_FLIGHT,
}
"""Presets by name."""


def noise_preset(name: str) -> SensorNoise:
    """Look a preset up by its name; dashes may stand for underscores.

    Raises:
        InputError: There is no such preset.
    """
    try:
        return PRESETS[name.replace("-", "_")]
    except KeyError:
        raise InputError(
            f"no sensor noise is called {name!r}: choose one of {', '.join(PRESETS)}"
        ) from None
