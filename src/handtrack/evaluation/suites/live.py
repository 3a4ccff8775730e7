"""Suite `live`: the live loop for minutes: memory, dropped frames, age of results."""

from __future__ import annotations

import os
import sys
import time
from array import array
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.artifacts import artifact_path
from handtrack.camera.live import LiveDriver, LiveSequence
from handtrack.camera.readers.replay import ReplayDriver
from handtrack.camera.sequence import RecordedSequence
from handtrack.camera.source import open_sequence
from handtrack.errors import InputError
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.evaluation.timing import StageTimer, percentiles
from handtrack.optional import installed
from handtrack.tracking.tracker import HandTracker

_UNIT = 0.001
"""Step of the software camera's depth [m]."""
_SAMPLE_SECONDS = 1.0
"""How often memory is measured [s]."""


def live_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/live.toml`."""
    data = chosen(settings, cases)
    minutes = float(data["minutes"] if settings.minutes is None else settings.minutes)
    if not 0 < minutes < float("inf"):
        raise InputError(f"--minutes is {minutes:g}: expected more than 0")
    with open_sequence(artifact_path(data["sequence"])) as recording:
        if not isinstance(recording, RecordedSequence):
            raise InputError(f"{data['sequence']} is no recording")
        measured = [_measure(name, recording, minutes, data, settings) for name in data["trackers"]]
    source = measured[0]["source"]
    notes = [
        f"{case['tracker']}: {minutes:g} min of {source} at {data['frames_per_second']} frames/s: "
        f"{case['frames_tracked']} tracked, {case['frames_dropped']} dropped for newer ones; "
        f"age of a result when handed to the viewer {case['result_age_ms']['p50']:.1f} ms "
        f"(median), {case['result_age_ms']['p95']:.1f} ms (95th percentile); memory "
        f"{case['memory_growth_mb']:+.1f} MB after {case['settled_seconds']:.0f} s at most"
        for case in measured
    ]
    return SuiteResult(
        suite="live",
        cases=measured,
        targets=judged(measured, data["targets"], data["trackers"][0]),
        notes=notes,
    )


def _measure(
    name: str,
    recording: RecordedSequence,
    minutes: float,
    data: Mapping[str, Any],
    settings: SuiteSettings,
) -> dict[str, Any]:
    """The case of one tracker."""
    subject = recording.subject
    tracker = HandTracker(
        recording.camera, side=(subject.side if subject else None) or "right", tracker=name,
        device=settings.device, seed=settings.seed,
    )  # fmt: skip
    if not tracker.automatic:
        raise InputError(f"the tracker {name!r} needs a first pose, which no camera tells")
    # Kernels are compiled before the clock starts, as they are before a camera is opened.
    tracker.track(recording[0].depth)
    ages, memory, moments, timer = array("d"), array("d"), array("d"), StageTimer()
    found = 0
    with ExitStack() as stack:
        source, driver, sent = _camera(recording, int(data["frames_per_second"]), stack)
        live = stack.enter_context(LiveSequence(driver, format="live"))
        begin = time.perf_counter()
        sent_before = 0
        for frame in _until(live, begin + 60.0 * minutes):
            if not len(ages):
                sent_before = sent()
            result = tracker.track(frame.depth)
            now = time.perf_counter()
            # Sources of this suite stamp by the clock of the host, so exposure is known here.
            ages.append(1e3 * (now - frame.time))
            timer.add_frame({}, total_ms=result.timings.get("total", 0.0))
            found += result.state.sure
            if not len(moments) or now - begin - moments[-1] >= _SAMPLE_SECONDS:
                memory.append(resident_mb())
                moments.append(now - begin)
        sent_in_all = sent() - sent_before + 1
        dropped, spent = live.dropped, time.perf_counter() - begin
    settled = min(float(data["settled_seconds"]), spent / 3)
    speed = timer.summary().to_dict()
    return {
        "case": "live", "tracker": name, "source": source, "minutes": minutes,
        **{key: value for key, value in speed.items() if key != "stage_ms"},
        "frames_per_second": len(ages) / spent,
        "frames_sent": sent_in_all, "frames_tracked": len(ages), "frames_dropped": dropped,
        "frames_unaccounted": abs(sent_in_all - len(ages) - dropped),
        "frames_found": found,
        "result_age_ms": percentiles(np.frombuffer(ages)),
        "settled_seconds": settled,
        "memory_mb": [round(value, 1) for value in memory[:: max(1, len(memory) // 60)]],
        "memory_growth_mb": growth(np.frombuffer(memory), np.frombuffer(moments), settled),
    }  # fmt: skip


def growth(samples: NDArray[np.float64], times: NDArray[np.float64], settled: float) -> float:
    """How far memory rose above where it was when it had settled [MB].

    Args:
        samples: Memory [MB], shape (n,).
        times: When it was measured [s], shape (n,), ascending.
        settled: From when on it counts [s].

    Returns:
        The highest later sample minus the first that counts; 0 where none does.
    """
    later = samples[times >= settled]
    return float(later.max() - later[0]) if len(later) else 0.0


def resident_mb() -> float:
    """Memory that this process holds now [MB]; the most it ever held, where that is not told."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return 1e-6 * pages * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return 1e-6 * most * (1 if sys.platform == "darwin" else 1024)


def _camera(
    recording: RecordedSequence, rate: int, stack: ExitStack
) -> tuple[str, LiveDriver, Any]:
    """A camera that sees the recording: what it is, its driver, and what counts its frames."""
    if not installed("realsense"):
        driver = ReplayDriver(recording, frames_per_second=rate)
        return "a replay (pyrealsense2 is not installed)", driver, lambda: driver.number
    from handtrack.camera.readers.realsense_live import RealSenseDriver
    from handtrack.camera.readers.software_camera import SoftwareCamera, SoftwareCameraFeed

    steps = [np.rint(frame.depth / _UNIT).astype(np.uint16) for frame in recording]
    camera = SoftwareCamera(recording.camera, unit=_UNIT, frames_per_second=rate)
    feed = stack.enter_context(SoftwareCameraFeed(camera, steps))
    return "librealsense's software device", RealSenseDriver(find=feed.devices), lambda: feed.pushed


def _until(live: LiveSequence, end: float) -> Iterator[Any]:
    """Frames until a time of `time.perf_counter` [s]."""
    for frame in live:
        if time.perf_counter() >= end:
            return
        yield frame
