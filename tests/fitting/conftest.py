"""Depth images of known poses, and traps for memory allocation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.fitting.config import FitConfig
from handtrack.fitting.fitter import Fitter
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import ShapedHand
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.transforms import apply_increment
from oracles.scenes import SMALL_CAMERA, hand_centre, rounded, seen_poses, shaped_hand

CAMERAS = {
    "160x120": SMALL_CAMERA,
    "320x240": Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0),
    "640x480": Camera(width=640, height=480, fx=588.0, fy=587.0, cx=322.0, cy=238.0),
}

START_NOISE = np.repeat([0.004, 0.04, 0.06], [3, 3, 21])
"""Largest departure of a start pose from the truth: about a frame of quick motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Images of one person's hand in several poses, and poses near them to start from."""

    hand: ShapedHand
    camera: Camera
    truth: NDArray[np.float64]
    start: NDArray[np.float64]
    depth: NDArray[np.float32]

    def fitter(self, device: str, *, images: int | None = None, **options: object) -> Fitter:
        """A fitter with the first images loaded, crops laid and poses set to the starts."""
        count = len(self.truth) if images is None else images
        # One thread unless a test asks for more: results are the same, failures easier to read.
        options = {"threads": 1, **options}
        fitter = Fitter([self.hand] * count, self.camera, device=device, **options)
        fitter.load_depth(self.depth[:count])
        fitter.place(hand_centre(self.hand, self.start[:count]))
        fitter.set_poses(np.repeat(self.start[:count], fitter.nhyp, axis=0))
        return fitter

    def keypoint_errors(self, poses: NDArray) -> NDArray[np.float64]:
        """Mean keypoint error of each image's pose [m], shape (n,)."""
        found = keypoints(self.hand, np.asarray(poses, np.float64))
        gap = found - keypoints(self.hand, self.truth[: len(found)])
        return np.linalg.norm(gap, axis=-1).mean(1)

    def depth_errors(self, device: str) -> NDArray[np.float32]:
        """Depth error of each image's true pose [m], shape (n,)."""
        fitter = self.fitter(device, config=FitConfig(iterations=0))
        fitter.set_poses(self.truth)
        fitter.run()
        return fitter.errors


@cache
def _scene(side: str, camera: str, count: int, seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    hand = shaped_hand(side, 3)
    distance = 0.7 if camera == "640x480" else 0.45
    truth = seen_poses(hand, rng, count, distance=distance, turn=0.3, bend=0.25)
    start = apply_increment(truth, START_NOISE * rng.uniform(-1, 1, (count, 27)))
    depth = DepthRenderer(hand, CAMERAS[camera], device="cpu", batch=4).render(truth)
    return Scene(hand=hand, camera=CAMERAS[camera], truth=truth, start=rounded(start), depth=depth)


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """Make a scene: `make_scene(side=..., camera=..., count=..., seed=...)`; scenes are kept."""

    def make(
        *, side: str = "right", camera: str = "160x120", count: int = 4, seed: int = 1
    ) -> Scene:
        return _scene(side, camera, count, seed)

    return make


@pytest.fixture
def no_allocation(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], object]:
    """Context in which Warp may not allocate: `with no_allocation(device): ...`."""

    @contextmanager
    def trap(device: str) -> Iterator[None]:
        def refuse(size_in_bytes: int) -> int:
            raise AssertionError(f"Warp allocated {size_in_bytes} bytes")

        owner = wp.get_device(device)
        names = ("default_allocator", "pinned_allocator", "current_allocator", "mempool_allocator")
        found = [(wp.get_device("cpu"), n) for n in names[:2]] + [(owner, n) for n in names]
        with monkeypatch.context() as patch:
            for holder, name in found:
                allocator = getattr(holder, name, None)
                if allocator is not None:
                    patch.setattr(allocator, "allocate", refuse)
            yield

    return trap


@pytest.fixture(scope="session")
def quick_config() -> FitConfig:
    """The default settings on a coarser crop."""
    return FitConfig(crop_cells=64)
