"""Motion models of grip modes on a device, side by side, for kernels that decode particles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.linalg import solve_triangular

from handtrack.errors import InputError
from handtrack.grasp.motion_model import GripModel
from handtrack.hand.skeleton import NV
from handtrack.kernels.grasp_motion import vec27


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceModels:
    """Arrays named and shaped as `kernels.grasp_motion` takes them."""

    counts: wp.array
    bases: wp.array
    shapes: wp.array
    times: wp.array
    log_shares: wp.array
    means: wp.array
    whiteners: wp.array
    nref: int
    """Most frames of a reference."""
    nweight: int
    """Most weights of a motion."""

    @classmethod
    def upload(cls, models: Sequence[GripModel], device: wp.Device) -> DeviceModels:
        """Copy models to a device, each filled up with zeros to the largest.

        Raises:
            InputError: There are no models.
        """
        if not models:
            raise InputError("no motion models are given; expected at least one")
        counts = np.array([
            (model.nshape, model.ntime, len(model.shape_mean), len(model.shares))
            for model in models
        ], np.int32)  # fmt: skip
        nshape, ntime, nref, ncomponent = counts.max(0).tolist()
        nweight = max(model.nweight for model in models)
        shapes = np.zeros((len(models), nref, 1 + nshape, NV), np.float32)
        times = np.zeros((len(models), nref - 1, 1 + ntime), np.float32)
        log_shares = np.zeros((len(models), ncomponent), np.float32)
        means = np.zeros((len(models), ncomponent, nweight), np.float32)
        whiteners = np.zeros((len(models), ncomponent, nweight, nweight), np.float32)
        for k, model in enumerate(models):
            frames, size, there = len(model.shape_mean), model.nweight, len(model.shares)
            shapes[k, :frames, 0] = model.shape_mean
            shapes[k, :frames, 1 : 1 + model.nshape] = np.swapaxes(model.shape_modes, 0, 1)
            times[k, : frames - 1, 0] = model.time_mean
            times[k, : frames - 1, 1 : 1 + model.ntime] = model.time_modes.T
            means[k, :there, :size] = model.means
            for c, factor in enumerate(model.factors):
                whiteners[k, c, :size, :size] = solve_triangular(factor, np.eye(size), lower=True)
                volume = np.log(np.diag(factor)).sum() + 0.5 * size * np.log(2.0 * np.pi)
                log_shares[k, c] = np.log(model.shares[c]) - volume
        bases = np.stack([model.base[3:7] for model in models]).astype(np.float32)

        def put(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        return cls(
            counts=put(counts, int), bases=put(bases, wp.vec4), shapes=put(shapes, vec27),
            times=put(times, float), log_shares=put(log_shares, float), means=put(means, float),
            whiteners=put(whiteners, float), nref=nref, nweight=nweight,
        )  # fmt: skip
