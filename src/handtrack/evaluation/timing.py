"""Timing of stages over many frames: latency percentiles, time per stage, rate with its spread."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from handtrack.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class TimingSummary:
    """Speed over a set of frames; `to_dict` gives the keys of the benchmark file."""

    frames: int
    """Number of frames measured."""
    latency_ms: dict[str, float]
    """Time per frame [ms]: "p50", "p95", "p99"."""
    stage_ms: dict[str, float]
    """Median time of each stage in the frames that ran it [ms], in the order in which the stages
    were first seen."""
    frames_per_second: float
    """Median of the frames' rates [1/s]."""
    frames_per_second_spread: tuple[float, float]
    """Quartiles of the frames' rates [1/s]: a quarter of the frames is slower than the first, a
    quarter faster than the second."""

    def to_dict(self) -> dict[str, Any]:
        """Return the speed part of a benchmark case."""
        return {
            "frames": self.frames,
            "frames_per_second": self.frames_per_second,
            "frames_per_second_spread": list(self.frames_per_second_spread),
            "latency_ms": dict(self.latency_ms),
            "stage_ms": dict(self.stage_ms),
        }


class StageTimer:
    """Collects how long every stage of every frame took.

    Either measure here::

        timer = StageTimer()
        for frame in frames:
            with timer.frame():
                with timer.stage("render"):
                    ...

    or hand over what was measured elsewhere: ``timer.add_frame(hand.timings)``.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        """Start without any frame.

        Args:
            clock: Gives the time [s]; only differences are used.
        """
        self._clock = clock
        self._frames: list[tuple[float, dict[str, float]]] = []
        self._open: dict[str, float] | None = None

    def __len__(self) -> int:
        """Number of frames collected."""
        return len(self._frames)

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Time one frame; stages inside belong to it. A frame that raises is not counted."""
        if self._open is not None:
            raise InputError("StageTimer.frame cannot be opened inside another frame")
        self._open = {}
        start = self._clock()
        try:
            yield
            self.add_frame(self._open, total_ms=1e3 * (self._clock() - start))
        finally:
            self._open = None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage of the frame that is open; a stage run twice in a frame adds up."""
        if self._open is None:
            raise InputError(
                f"StageTimer.stage({name!r}) needs an open frame: use it inside StageTimer.frame()"
            )
        start = self._clock()
        try:
            yield
        finally:
            spent = 1e3 * (self._clock() - start)
            if self._open is not None:
                self._open[name] = self._open.get(name, 0.0) + spent

    def add_frame(self, stages_ms: Mapping[str, float], *, total_ms: float | None = None) -> None:
        """Add one frame that was timed elsewhere.

        Args:
            stages_ms: Stage -> time [ms].
            total_ms: Time of the whole frame [ms]; the sum of the stages without.
        """
        total = sum(stages_ms.values()) if total_ms is None else total_ms
        if not (np.isfinite(total) and total >= 0.0):
            raise InputError(
                f"a frame took {total} ms: expected a finite time that is not negative"
            )
        self._frames.append((float(total), {name: float(ms) for name, ms in stages_ms.items()}))

    def summary(self, *, skip: int = 0) -> TimingSummary:
        """Summarise the frames collected so far.

        Args:
            skip: Leave so many frames at the start out (first launches load and compile kernels).

        Raises:
            InputError: No frame is left.
        """
        frames = self._frames[skip:]
        if not frames:
            raise InputError(
                f"no frames to summarise: {len(self)} were timed and {skip} are skipped"
            )
        totals = np.array([total for total, _ in frames])
        stages: dict[str, list[float]] = {}
        for _, times in frames:
            for name, spent in times.items():
                stages.setdefault(name, []).append(spent)
        # A clock too coarse for a frame would give an infinite rate.
        rates = 1e3 / np.maximum(totals, 1e-6)
        return TimingSummary(
            frames=len(totals),
            latency_ms=percentiles(totals),
            stage_ms={name: float(np.median(times)) for name, times in stages.items()},
            frames_per_second=float(np.median(rates)),
            frames_per_second_spread=(
                float(np.percentile(rates, 25.0)),
                float(np.percentile(rates, 75.0)),
            ),
        )


def percentiles(values: ArrayLike) -> dict[str, float]:
    """Median, 95th and 99th percentile of values, shape (n,), as "p50", "p95", "p99"."""
    p50, p95, p99 = np.percentile(np.asarray(values, dtype=np.float64), (50.0, 95.0, 99.0))
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}
