"""Start poses along the principal axes of what is seen (II.4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.kernels.forest_features import NSTART, principal_starts
from handtrack.transforms import quat_to_matrix
from oracles.device_arrays import download, poisoned, upload
from oracles.forest import gated_points, start_palms
from oracles.scenes import rounded

Float = NDArray[np.float64]

MEAN_TOLERANCE = 1e-5
"""Some roundings of float32 at half a metre, summed over the points [m]."""

AXIS_TOLERANCE = 0.02
"""`wp.eig3` may leave a thousandth of the largest moment beside the diagonal; over the smaller
moments' gap that turns two axes by up to a degree [rad, m]."""


def slab_cells(
    size: int, *, angle: float, slope: float, along: float = 0.08, across: float = 0.03
) -> Float:
    """A thin slab about (0.01, -0.02, 0.45), long in one direction; a wall far behind it."""
    focal, middle = size * 1.0, (size - 1) / 2
    rows, columns = np.mgrid[:size, :size]
    z = 0.45 + slope * (columns - middle) / focal
    x, y = (columns - middle) / focal * z - 0.01, (rows - middle) / focal * z + 0.02
    turned = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
    slab = (np.abs(turned[0]) < along) & (np.abs(turned[1]) < across)
    return rounded(np.where(slab, z, 0.9))


@dataclass(frozen=True)
class StartScene:
    """Images of slabs and the hands that are expected there."""

    cells: Float
    cameras: Float
    gates: Float
    palm_points: Float
    angles: Float
    image_hand: NDArray

    @classmethod
    def random(cls, rng: np.random.Generator, nimage: int = 7, size: int = 48) -> StartScene:
        cells = np.stack([
            slab_cells(size, angle=rng.uniform(0, np.pi), slope=rng.uniform(-0.3, 0.3))
            for _ in range(nimage)
        ])  # fmt: skip
        kind = rng.random(cells.shape)
        cells[kind < 0.05] = np.inf
        cells[kind > 0.95] = np.nan
        middle = (size - 1) / 2
        gate = [0.01, -0.02, 0.45, 0.11]
        return cls(
            cells=cells,
            cameras=np.tile(rounded(np.array([size, size, middle, middle])), (nimage, 1)),
            gates=rounded(np.array(gate) + rng.normal(0, 0.005, (nimage, 4)) * [1, 1, 1, 0]),
            palm_points=rounded(rng.normal(0.0, 0.05, (3, 6, 3))),
            angles=rounded(rng.normal(0.0, 0.3, (3, 21))),
            image_hand=rng.integers(0, 3, nimage),
        )

    def starts(self, device: str, mirror: float = 1.0, stride: int = 1) -> Float:
        poses = poisoned((len(self.cells), NSTART, 28), device)
        principal_starts(
            upload(self.palm_points, device, wp.vec3), upload(self.angles, device),
            upload(self.image_hand, device), upload(self.cells, device),
            upload(self.cameras, device), upload(self.gates, device),
            middle_point=2, mirror=mirror, stride=stride, poses=poses,
        )  # fmt: skip
        return download(poses)

    def middle(self, image: int) -> Float:
        return self.palm_points[self.image_hand[image], 2]

    def changed(self, **changes: NDArray) -> StartScene:
        return StartScene(**{**self.__dict__, **changes})


def assert_same_palms(poses: Float, palms: list[tuple[Float, Float]]) -> None:
    """Each of the palms is one of the poses; their order is free, as are the signs of axes."""
    rotations = quat_to_matrix(poses[:, 3:7])
    taken = set()
    for rotation, origin in palms:
        gaps = np.abs(rotations - rotation).max((1, 2))
        best = int(gaps.argmin())
        taken.add(best)
        np.testing.assert_allclose(rotations[best], rotation, atol=AXIS_TOLERANCE)
        np.testing.assert_allclose(poses[best, :3], origin, atol=AXIS_TOLERANCE)
    assert taken == set(range(NSTART))


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_start_poses_follow_the_principal_axes(device, rng, mirror, stride) -> None:
    scene = StartScene.random(rng)
    if mirror < 0:
        scene = scene.changed(gates=scene.gates * [-1, 1, 1, 1])
    poses = scene.starts(device, mirror, stride)
    for image in range(len(poses)):
        points = gated_points(
            scene.cells[image], scene.cameras[image], scene.gates[image], mirror, stride
        )
        assert len(points) > 5
        assert_same_palms(poses[image], start_palms(points, scene.middle(image)))
        np.testing.assert_array_equal(
            poses[image, :, 7:], np.tile(scene.angles[scene.image_hand[image]], (NSTART, 1))
        )


def test_the_middle_knuckle_starts_in_the_mean_of_what_is_seen(device, rng) -> None:
    scene = StartScene.random(rng)
    poses = scene.starts(device)
    for image, of_image in enumerate(poses):
        points = gated_points(scene.cells[image], scene.cameras[image], scene.gates[image], 1.0, 1)
        knuckles = quat_to_matrix(of_image[:, 3:7]) @ scene.middle(image) + of_image[:, :3]
        np.testing.assert_allclose(
            knuckles, np.tile(points.mean(0), (NSTART, 1)), atol=MEAN_TOLERANCE
        )


def test_a_hand_held_upright_starts_upright(device, rng) -> None:
    cells = slab_cells(48, angle=np.pi / 2, slope=0.0)[None]
    scene = StartScene.random(rng, nimage=1).changed(
        cells=cells, gates=np.array([[0.01, -0.02, 0.45, 0.15]])
    )
    rotations = quat_to_matrix(scene.starts(device)[0, :, 3:7])
    np.testing.assert_allclose(np.abs(rotations[:, 1, 0]), 1.0, atol=0.01)
    np.testing.assert_allclose(np.abs(rotations[:, 2, 1]), 1.0, atol=0.01)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_a_mirrored_image_gives_the_same_starts_in_the_mirror(device, rng, stride) -> None:
    scene = StartScene.random(rng)
    cameras = scene.cameras.copy()
    cameras[:, 2] = scene.cells.shape[2] - 1 - cameras[:, 2]
    poses = scene.starts(device, 1.0, stride)
    flipped = scene.changed(cells=scene.cells[:, :, ::-1], cameras=cameras)
    mirrored = flipped.starts(device, -1.0, stride)
    for one, other in zip(poses, mirrored, strict=True):
        palms = list(zip(quat_to_matrix(one[:, 3:7]), one[:, :3], strict=True))
        assert_same_palms(other, palms)


@pytest.mark.parametrize("kind", ["nothing", "unknown", "not a number", "elsewhere", "one point"])
def test_an_image_without_a_hand_starts_at_the_gate(device, rng, kind) -> None:
    scene = StartScene.random(rng, nimage=3)
    cells, gates = scene.cells.copy(), scene.gates.copy()
    if kind == "elsewhere":
        gates[1, :3] += 2.0
    elif kind == "one point":
        cells[1] = 0.0
        cells[1, 24, 24] = 0.45
    else:
        cells[1] = {"nothing": 0.0, "unknown": np.inf, "not a number": np.nan}[kind]
    poses = scene.changed(cells=cells, gates=gates).starts(device)
    assert np.isfinite(poses).all()
    rotations = quat_to_matrix(poses[1, :, 3:7])
    np.testing.assert_allclose(np.linalg.norm(poses[1, :, 3:7], axis=1), 1.0, atol=1e-5)
    knuckles = rotations @ scene.middle(1) + poses[1, :, :3]
    expected = gates[1, :3]
    if kind == "one point":
        ray = (24 - scene.cameras[1, 2]) / scene.cameras[1, 0]
        expected = np.array([ray, ray, 1.0]) * 0.45
    np.testing.assert_allclose(knuckles, np.tile(expected, (NSTART, 1)), atol=1e-5)
    np.testing.assert_array_equal(poses[[0, 2]], scene.starts(device)[[0, 2]])


def test_starts_of_an_image_do_not_depend_on_the_others(device, rng) -> None:
    scene = StartScene.random(rng)
    together = scene.starts(device)
    for image in (0, 6):
        one = slice(image, image + 1)
        alone = scene.changed(
            cells=scene.cells[one], cameras=scene.cameras[one], gates=scene.gates[one],
            image_hand=scene.image_hand[one],
        ).starts(device)  # fmt: skip
        np.testing.assert_array_equal(alone[0], together[image])
