"""Fixtures that several stages share: the recordings, the compute devices, random numbers."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

_CHECKOUT = Path(__file__).resolve().parents[1]


def _devices() -> list[object]:
    """The CPU always; the first GPU where Warp finds one."""
    # Asking the driver is far quicker than importing Warp while tests are being collected.
    has_gpu = any(Path("/dev").glob("nvidia[0-9]*")) or Path("/dev/dxg").exists()
    gpu = pytest.param(
        "cuda:0",
        marks=[pytest.mark.gpu, *([] if has_gpu else [pytest.mark.skip("no CUDA device")])],
    )
    return ["cpu", gpu]


@pytest.fixture(params=_devices())
def device(request: pytest.FixtureRequest) -> str:
    """Compute device: a test that asks for it runs on the CPU and, where there is one, the GPU."""
    if request.param != "cpu":
        import warp as wp

        if not wp.is_cuda_available():
            pytest.skip("no CUDA device that Warp can use")
    return request.param


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder with the recordings of others (see the marker `data`)."""
    named = os.environ.get("HANDTRACK_RECORDINGS")
    folder = Path(named) if named else _CHECKOUT.parent / "shared" / "data"
    if not folder.is_dir():
        wanted = f"HANDTRACK_RECORDINGS={named}" if named else "../shared/data beside the checkout"
        pytest.skip(f"recordings are missing: {wanted} is not a folder")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20170817)
