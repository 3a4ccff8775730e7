"""Time from starting Python to the first result, with compiled kernels at hand and without."""

from __future__ import annotations

import tempfile

from handtrack.errors import HandtrackError
from handtrack.evaluation.suites.own_process import OwnProcessError, run_script

_LIMIT_SECONDS = 1800.0

_SCRIPT = """
import json, sys, time
clock = [time.perf_counter()]
import numpy as np
import warp as wp
wp.config.log_level = wp.LOG_ERROR
import handtrack as ht
wp.init()
clock.append(time.perf_counter())
camera = ht.Camera(width=320, height=240, fx=241.42, fy=241.42, cx=160.0, cy=120.0)
tracker = ht.HandTracker(camera, device=sys.argv[1])
clock.append(time.perf_counter())
pose = np.zeros(28)
pose[2:4] = 0.45, 1.0
depth = np.full(camera.shape, 0.45, np.float32)
tracker.reset(pose)
tracker.track(depth)
clock.append(time.perf_counter())
print(json.dumps(dict(zip(("import", "construct", "first frame"), np.diff(clock).tolist()))))
"""


class StartUpError(HandtrackError, RuntimeError):
    """A tracker could not be started in a process of its own."""


def measure_start(device: str, *, cold: bool) -> dict[str, float]:
    """Start a tracker in a process of its own and track one frame.

    Args:
        device: "cpu" or "cuda:N".
        cold: Start with an empty kernel cache, as after an installation: every kernel is compiled.

    Returns:
        Seconds: "import", "construct" (upload of the hand, buffers), "first frame" (loads or
        compiles the kernels and captures the graph).

    Raises:
        StartUpError: The process failed or took over half an hour.
    """
    if not cold:
        # Once unmeasured, so that the kernels are compiled and the files are in memory.
        _start(device, None)
        return _start(device, None)
    with tempfile.TemporaryDirectory(prefix="handtrack-cold-") as cache:
        return _start(device, cache)


def _start(device: str, cache: str | None) -> dict[str, float]:
    """One process; a kernel cache of its own when a folder is given."""
    variables = {} if cache is None else {"WARP_CACHE_PATH": cache}
    try:
        return run_script(_SCRIPT, [device], limit_seconds=_LIMIT_SECONDS, variables=variables)
    except OwnProcessError as error:
        raise StartUpError(f"starting a tracker in its own process failed: {error}") from error
