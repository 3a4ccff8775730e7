"""Kernels that decode particles, against the motion model in float64 NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from handtrack.grasp.device_models import DeviceModels
from handtrack.grasp.motion_model import GraspMotionModel, GripModel
from handtrack.grasp.swarm import NPLACE, SwarmConfig, draw_places, place_motions
from handtrack.kernels.grasp_motion import Placing, decode_particles, decode_rows
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix
from oracles.device_arrays import GARBAGE, download, poisoned, upload

UPRIGHT = rotvec_to_matrix(np.array([0.3, -1.0, 0.4]))
NFRAME = 5


@pytest.fixture(scope="module")
def models() -> list[GripModel]:
    grips = GraspMotionModel.load().grips
    # Models of different sizes, one of which is a mixture.
    return [grips["tripod"], grips["middle_pinch"], grips["medium_wrap"]]


class Decoded:
    """Particles of three grip modes, decoded on a device and on the host."""

    def __init__(
        self, models: list[GripModel], device: str, rng: np.random.Generator, count: int,
        dead: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        model = DeviceModels.upload(models, wp.get_device(device))
        grips, width = rng.integers(0, 3, count), model.nweight
        positions = rng.normal(size=(count, width + NPLACE))
        positions[:, width:] = draw_places(count, None, config=SwarmConfig(), rng=rng)
        self.densities, motions = np.zeros(count), np.zeros((count, NFRAME, 28))
        for k, grip in enumerate(grips):
            weights = positions[k : k + 1, : models[grip].nweight] * 1.5
            positions[k, : models[grip].nweight] = weights[0]
            motions[k] = models[grip].motions(weights, NFRAME)[0]
            self.densities[k] = models[grip].log_density(weights)[0]
        places = positions[:, width:]
        self.densities += SwarmConfig().log_prior(places)
        self.motions = place_motions(motions, places, UPRIGHT)

        placing: Any = Placing()
        placing.upright = wp.vec4(*matrix_to_quat(UPRIGHT).tolist())
        placing.offset_spread = SwarmConfig().offset_spread
        placing.tilt_spread = SwarmConfig().tilt_spread
        put, numbers = upload(positions, device), upload(grips, device)
        lows = poisoned((NFRAME, count), device, int)
        parts = poisoned((NFRAME, count), device)
        turns, bases = (poisoned(count, device, wp.vec4) for _ in range(2))
        shifts = poisoned(count, device, wp.vec3)
        found = poisoned(count, device)
        decode_particles(
            model.counts, model.bases, model.times, model.log_shares, model.means,
            model.whiteners, wp.array([placing], dtype=Placing, device=device), put, numbers,
            warps=poisoned((count, model.nref), device), lows=lows, parts=parts, turns=turns,
            shifts=shifts, placed_bases=bases, densities=found,
        )  # fmt: skip
        row_hand = np.zeros(NFRAME * count)
        row_hand[list(dead)] = -1
        pose = poisoned((NFRAME * count, 28), device)
        decode_rows(
            model.counts, model.shapes, upload(row_hand.astype(int), device), put, numbers, lows,
            parts, turns, shifts, bases, pose=pose,
        )  # fmt: skip
        assert (download(lows) != GARBAGE).all()
        self.found_densities, self.rows = download(found), download(pose)
        self.found = np.swapaxes(self.rows.reshape(NFRAME, count, 28), 0, 1)[:, ::-1]


def test_poses_are_those_of_the_motion_model_placed_about_the_object(
    device: str, models: list[GripModel], rng: np.random.Generator
) -> None:
    decoded = Decoded(models, device, rng, 40)
    found = decoded.found.copy()
    # A quaternion and its negative are one turn.
    same = np.sign((found[..., 3:7] * decoded.motions[..., 3:7]).sum(-1, keepdims=True))
    found[..., 3:7] *= same
    np.testing.assert_allclose(found, decoded.motions, atol=2e-5)


def test_log_density_is_that_of_mixture_and_placement(
    device: str, models: list[GripModel], rng: np.random.Generator
) -> None:
    decoded = Decoded(models, device, rng, 40)
    assert np.ptp(decoded.densities) > 5.0
    np.testing.assert_allclose(decoded.found_densities, decoded.densities, rtol=2e-5, atol=2e-4)


def test_rows_that_are_left_out_are_not_written(
    device: str, models: list[GripModel], rng: np.random.Generator
) -> None:
    decoded = Decoded(models, device, rng, 7, dead=(3, 20))
    unwritten = np.isnan(decoded.rows).all(1)
    np.testing.assert_array_equal(np.flatnonzero(unwritten), [3, 20])
    assert np.isfinite(decoded.rows[~unwritten]).all()
