"""Compute devices and captured graphs: one frame's launches recorded once and replayed."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from handtrack.errors import DeviceError


def resolve_device(device: str | None = None) -> wp.Device:
    """The Warp device behind a name.

    Args:
        device: "cpu", "cuda:N", or None / "auto" for the first GPU when there is one.

    Raises:
        DeviceError: There is no such device here.
    """
    wp.init()
    if device is None or device == "auto":
        return wp.get_device("cuda:0") if wp.is_cuda_available() else wp.get_device("cpu")
    try:
        return wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        names = ", ".join(str(d.alias) for d in wp.get_devices())
        raise DeviceError(
            f"device {device!r} is not available; this machine has: {names}"
        ) from error


class FrameGraph:
    """A function of launches on one device: run eagerly once, captured, then replayed.

    Scalars are frozen at capture; whatever changes between calls must live in device arrays.
    """

    def __init__(self, run: Callable[[], None], device: wp.Device, *, graph: bool = True) -> None:
        """Wrap `run`, which must launch on `device` only and allocate nothing.

        Args:
            run: Launches the work of one frame.
            device: Device of all launches.
            graph: False runs eagerly every time, for debugging.
        """
        self._run = run
        self._device = device
        self._use_graph = graph
        self._graph: wp.Graph | None = None

    @property
    def replays(self) -> bool:
        """Whether the next call replays; until then calls must come from one thread at a time."""
        return self._graph is not None or not self._use_graph

    def __call__(self) -> None:
        """Do the work once."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        # The first, eager pass loads the modules, which a capture must not do.
        self._run()
        if self._use_graph:
            with wp.ScopedCapture(device=self._device) as capture:
                self._run()
            self._graph = capture.graph
