"""Time of each stage of the fit: the frame's graph taken apart at the stages' borders.

A frame is one captured graph, inside which nothing can be timed. Here every stage is captured as a
graph of its own and all are replayed in the frame's order, so that each works on what the one
before it left. The sum is a little longer than the frame, by the launches of more graphs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import warp as wp

from handtrack.errors import InputError
from handtrack.fitting.fitter import Fitter

NAMES: dict[str, str] = {
    "pose": "kinematics+skinning", "match": "correspondences", "system": "normal equations",
    "step": "solve", "score": "render+score",
}  # fmt: skip
"""Stage of the fitter -> what it is called in tables, where its own name does not say it."""

OTHER = "other"
"""What is launched between the stages."""

_PREFIX, _WHOLE = "_launch_", "_launch_refine"


class StagedFitter(Fitter):
    """A fitter whose stages can be timed one by one."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Allocate as `Fitter` does."""
        super().__init__(*args, **kwargs)
        self._recorded: list[tuple[str, wp.Graph]] = []
        self._recording = False
        for name in dir(self):
            if name.startswith(_PREFIX) and name != _WHOLE:
                setattr(self, name, self._bordered(name.removeprefix(_PREFIX), getattr(self, name)))
        self._stages: list[tuple[str, list[wp.Graph]]] | None = None

    @property
    def threads(self) -> int:
        """Number of host threads that share the rows."""
        return len(self._splits)

    def run_staged(self) -> dict[str, float]:
        """Do what `run` does, stage by stage.

        Returns:
            Time spent per stage [ms].
        """
        if self._stages is None:
            poses = self.poses
            # Kernels must be loaded before they are captured.
            self.run()
            self._stages = self._record()
            self.rows.pose.assign(poses)
        spent: dict[str, float] = {}
        wp.synchronize_device(self.device)
        for name, graphs in self._stages:
            begin = time.perf_counter()
            # Waking threads takes longer than the little between the stages.
            if len(graphs) > 1 and self._pool is not None and name != OTHER:
                list(self._pool.map(wp.capture_launch, graphs))
            else:
                for graph in graphs:
                    wp.capture_launch(graph)
            wp.synchronize_device(self.device)
            spent[name] = spent.get(name, 0.0) + 1e3 * (time.perf_counter() - begin)
        return spent

    def _record(self) -> list[tuple[str, list[wp.Graph]]]:
        """Capture every stage of the frame: name, and one graph per thread."""
        prepare = self._captured(self._launch_prepare)
        parts = [
            self._captured(lambda part=part: self._launch_refine(part)) for part in self._splits
        ]
        stages = [(name, [graph]) for name, graph in prepare]
        for same in zip(*parts, strict=True):
            if len({name for name, _ in same}) > 1:
                raise InputError("threads of a frame differ in their stages")
            stages.append((same[0][0], [graph for _, graph in same]))
        return stages

    def _captured(self, launch: Callable[[], None]) -> list[tuple[str, wp.Graph]]:
        """Stages of some launches in their order, each captured by itself."""
        self._recorded = []
        self._recording = True
        wp.capture_begin(device=self.device)
        try:
            launch()
        finally:
            self._recording = False
            self._recorded.append((OTHER, wp.capture_end(device=self.device)))
        return self._recorded

    def _bordered(self, name: str, launch: Callable[..., None]) -> Callable[..., None]:
        """A stage that is captured apart from what comes before and after it."""

        def bordered(*args: Any) -> None:
            if not self._recording:
                launch(*args)
                return
            self._recorded.append((OTHER, wp.capture_end(device=self.device)))
            # A stage that calls another one counts as a whole.
            self._recording = False
            wp.capture_begin(device=self.device)
            launch(*args)
            self._recorded.append((NAMES.get(name, name), wp.capture_end(device=self.device)))
            self._recording = True
            wp.capture_begin(device=self.device)

        return bordered
