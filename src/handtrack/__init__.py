"""handtrack: articulated 3D hand pose from one depth camera.

The stages, one folder each, in the order in which data flows through them::

    camera      depth frame, find the hand
       |
    hand        hand model: shape, skeleton, skin      objects    meshes to grasp
       |
    kernels     Warp kernels: kinematics, skinning, rendering, correspondences, solve
       |
    priors      which poses are plausible              synthesis  labelled depth frames
       |
    forest      proposes poses
       |
    fitting     Gauss-Newton ICP refines each proposal on one frame
       |
    tracking    memory over frames, picks the best  -> HandResult
       |
    physics     simulation of the hand                 grasp      synthesis and control
       |
    evaluation  metrics and benchmarks                 export     files and streams for others
       |
    viewer      pictures, videos, web viewer           cli        the `handtrack` command

A stage imports only stages above it. Names below are imported on first use, so that
``import handtrack`` is quick and loads neither Warp nor OpenCV.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from handtrack.errors import (
    DamagedFileError,
    DeviceError,
    HandtrackError,
    InputError,
    MissingDependencyError,
    MissingFileError,
)

if TYPE_CHECKING:
    from handtrack.camera.camera import Camera
    from handtrack.camera.frame import DepthFrame
    from handtrack.camera.source import open_sequence
    from handtrack.grasp.synthesis import synthesize_grasp
    from handtrack.hand.model import HandModel
    from handtrack.hand.shape import HandShape
    from handtrack.tracking.result import HandResult, TrackState
    from handtrack.tracking.shape_calibration import fit_shape
    from handtrack.tracking.tracker import HandTracker

    __version__: str

_HOMES = {
    "Camera": "handtrack.camera.camera",
    "DepthFrame": "handtrack.camera.frame",
    "HandModel": "handtrack.hand.model",
    "HandResult": "handtrack.tracking.result",
    "HandShape": "handtrack.hand.shape",
    "HandTracker": "handtrack.tracking.tracker",
    "TrackState": "handtrack.tracking.result",
    "fit_shape": "handtrack.tracking.shape_calibration",
    "open_sequence": "handtrack.camera.source",
    "synthesize_grasp": "handtrack.grasp.synthesis",
}

__all__ = [
    "Camera",
    "DamagedFileError",
    "DepthFrame",
    "DeviceError",
    "HandModel",
    "HandResult",
    "HandShape",
    "HandTracker",
    "HandtrackError",
    "InputError",
    "MissingDependencyError",
    "MissingFileError",
    "TrackState",
    "fit_shape",
    "open_sequence",
    "synthesize_grasp",
]


def _version() -> str:
    """Version of the installed distribution, "0+unknown" for a bare source tree."""
    # Imported here: importlib.metadata takes 20 ms and is seldom asked for.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("handtrack")
    except PackageNotFoundError:
        return "0+unknown"


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name == "__version__":
        value: Any = _version()
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'handtrack' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names, including those not imported yet."""
    return sorted({*__all__, "__version__"})
