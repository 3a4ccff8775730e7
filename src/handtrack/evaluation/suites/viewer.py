"""Suite `viewer`: what the web viewer costs the tracking loop, in a process of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from handtrack.artifacts import artifact_path
from handtrack.device import resolve_device
from handtrack.errors import HandtrackError
from handtrack.evaluation.suites.own_process import OwnProcessError, run_script
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, chosen, judged
from handtrack.evaluation.timing import StageTimer

_LIMIT_SECONDS = 1200.0

_CLIENT = """
import asyncio, sys, viser, websockets

async def receive():
    protocol = f"viser-v{viser.__version__}"
    address = sys.argv[1].replace("http", "ws")
    async with websockets.connect(address, subprotocols=[protocol], max_size=None) as server:
        print("connected", flush=True)
        async for _ in server:
            pass

asyncio.run(receive())
"""
"""A browser that takes all messages and draws nothing."""

_SCRIPT = """
import json, subprocess, sys, time
import warp as wp
wp.config.log_level = wp.LOG_ERROR
import handtrack as ht
from handtrack.viewer.controls import FASTEST, Controls, Wishes
from handtrack.viewer.loop import TrackingLoop
from handtrack.viewer.playback import Playback
from handtrack.viewer.viewer import NullViewer
from handtrack.viewer.web import WebViewer

device, name, path, rounds, frames, client_script = sys.argv[1:]
rounds, frames = int(rounds), int(frames)

class End:
    def __init__(self, controls):
        self.controls, self.times = controls, []
    def frame(self, frame, hand):
        self.times.append(time.perf_counter())
        if len(self.times) > frames:
            self.controls.stop()
    def close(self):
        pass

with ht.open_sequence(path) as sequence:
    tracker = ht.HandTracker(sequence.camera, device=device, tracker=name)
    for frame in (sequence[k] for k in range(20)):
        tracker.track(frame.depth)

    def turn(seen):
        controls = Controls(Wishes(tracker=name, speed=FASTEST))
        end, viewer, client = End(controls), NullViewer(), None
        if seen:
            viewer = WebViewer(controls, trackers=(name,), length=len(sequence), port=0,
                               draw_unseen=True)
            client = subprocess.Popen([sys.executable, "-c", client_script, viewer.url],
                                      stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            assert client.stdout.readline().strip() == "connected"
        loop = TrackingLoop(Playback(sequence), lambda _: tracker, controls, viewer=viewer,
                            sinks=[end])
        loop.run()
        spent = [1e3 * (b - a) for a, b in zip(end.times, end.times[1:])]
        if client is not None:
            client.kill()
            client.wait()
        return spent, 1e3 * viewer.drawn / sum(spent) if seen else 0.0

    turn(False), turn(True)
    turns = [(turn(False), turn(True)) for _ in range(rounds)]
print(json.dumps([{"alone": a[0], "seen": b[0], "drawn": b[1]} for a, b in turns]))
"""


class ViewerSuiteError(HandtrackError, RuntimeError):
    """The viewer could not be measured."""


def viewer_suite(settings: SuiteSettings, cases: Mapping[str, Any]) -> SuiteResult:
    """Run the suite; see `benchmarks/viewer.toml`."""
    data = chosen(settings, cases)
    device = resolve_device(settings.device)
    found, notes = [], []
    for tracker in settings.progress(data["trackers"], len(data["trackers"]), "viewer"):
        rounds = _rounds(device.alias, tracker, data)
        with_viewer = _case("with-viewer", tracker, [one["seen"] for one in rounds])
        found += [_case("without-viewer", tracker, [one["alone"] for one in rounds]), with_viewer]
        # Each round is compared with itself, for a machine's speed wanders.
        costs = [100.0 * (1.0 - sum(one["alone"]) / sum(one["seen"])) for one in rounds]
        low, middle, high = np.percentile(costs, [25.0, 50.0, 75.0])
        drawn = float(np.median([one["drawn"] for one in rounds]))
        with_viewer |= {
            "cost_percent": float(middle), "cost_percent_spread": [float(low), float(high)],
            "drawn_per_second": drawn,
        }  # fmt: skip
        notes.append(
            f"{tracker}: the viewer, drawing {drawn:.0f} views a second, costs {middle:.1f} % of "
            f"the loop's rate (quartiles of {len(rounds)} rounds {low:.1f} to {high:.1f} %)"
        )
    return SuiteResult(
        suite="viewer",
        cases=found,
        targets=judged(found, data["targets"], data["trackers"][0]),
        notes=notes,
    )


def _case(name: str, tracker: str, turns: list[list[float]]) -> dict[str, Any]:
    """A case of the benchmark file, from the time of every frame [ms] in every turn."""
    timer = StageTimer()
    for spent in (spent for turn in turns for spent in turn):
        timer.add_frame({}, total_ms=spent)
    speed = timer.summary().to_dict()
    return {"case": name, "tracker": tracker, **{k: v for k, v in speed.items() if k != "stage_ms"}}


def _rounds(device: str, tracker: str, data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Time of every frame [ms] in each round, "alone" and "seen", and views "drawn" per second."""
    words = [
        device, tracker, str(artifact_path(data["sequence"])), str(data["rounds"]),
        str(data["frames"]), _CLIENT,
    ]  # fmt: skip
    try:
        return run_script(_SCRIPT, words, limit_seconds=_LIMIT_SECONDS)
    except OwnProcessError as error:
        raise ViewerSuiteError(
            f"the loop with a viewer failed in its own process: {error}"
        ) from error
