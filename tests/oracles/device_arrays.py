"""Device arrays for kernel tests: inputs as they are, outputs full of garbage."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

GARBAGE = -123456789
"""What poisoned integers hold: no index, count, key or marker looks like it."""


def upload(values: ArrayLike, device: str, dtype: Any = None) -> wp.array:
    """Copy to a device; floats become float32, integers int32 unless `dtype` says otherwise."""
    array = np.ascontiguousarray(values)
    if dtype is None:
        dtype = int if array.dtype.kind in "iub" else float
    host = np.int32 if dtype is int else np.int64 if dtype is wp.int64 else np.float32
    return wp.array(array.astype(host), dtype=dtype, device=device)


def poisoned(shape: tuple[int, ...] | int, device: str, dtype: Any = float) -> wp.array:
    """An output array full of NaN or garbage: what a kernel fails to write shows."""
    array = wp.zeros(shape, dtype=dtype, device=device)
    host = array.numpy()
    array.assign(np.full_like(host, GARBAGE if host.dtype.kind == "i" else np.nan))
    return array


def download(array: wp.array) -> NDArray[Any]:
    """Copy to the host; floats become float64."""
    host = array.numpy().copy()
    return host.astype(np.float64) if host.dtype.kind == "f" else host
