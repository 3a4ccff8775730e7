"""Joint limits of the hand; `models/README.md` tells where each number comes from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtrack.hand.skeleton import ANGLES

LIMITS_DEGREES: dict[str, tuple[float, float]] = {
    "thumb_tm_flexion": (-35.0, 65.0),
    "thumb_tm_abduction": (-15.0, 65.0),
    "thumb_mcp_flexion": (-15.0, 75.0),
    "thumb_mcp_abduction": (-30.0, 25.0),
    "thumb_ip_flexion": (-25.0, 90.0),
    "mcp_flexion": (-35.0, 100.0),
    "index_mcp_abduction": (-20.0, 30.0),
    "middle_mcp_abduction": (-20.0, 20.0),
    "ring_mcp_abduction": (-20.0, 25.0),
    "little_mcp_abduction": (-20.0, 35.0),
    "pip_flexion": (-15.0, 120.0),
    "dip_flexion": (-20.0, 95.0),
}
"""Degrees; a name without a finger holds for index to little."""


def joint_limits() -> NDArray[np.float64]:
    """Lower and upper limit of each angle [rad], shape (21, 2)."""
    rows = []
    for name in ANGLES:
        key = name if name in LIMITS_DEGREES else name.split("_", 1)[1]
        rows.append(LIMITS_DEGREES[key])
    return np.radians(rows)
