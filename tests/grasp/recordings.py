"""Small made-up recordings for tests."""

import numpy as np

from handtrack.grasp.recording import GraspRecording
from handtrack.grasp.taxonomy import grip_mode
from handtrack.transforms import matrix_to_quat, rotvec_to_matrix

COUNTS = {"reaching": 12, "closing": 20, "manipulation": 15, "releasing": 10}


def recording(*, grip="tripod", trial=0, seed=0, size=0.0, counts=None, frame_rate=120.0):
    """A hand that comes along x, closes, and carries a thing aside; `size` opens the grasp."""
    rng = np.random.default_rng(seed)
    counts = counts or COUNTS
    total, mode = sum(counts.values()), grip_mode(grip)
    phases = np.repeat(list(counts), list(counts.values()))
    poses = np.zeros((total, 28))
    turn = rotvec_to_matrix(np.array([1.2, 0.1, 0.2]) + rng.normal(0.0, 0.02, 3))
    poses[:, 3:7] = matrix_to_quat(turn)
    start, end = counts["reaching"], counts["reaching"] + counts["closing"]
    x = np.interp(np.arange(total), [0, start, end - 1], [-0.3, -0.11, -0.10])
    poses[:, 0], poses[:, 2] = x, 0.05 + 0.3 * size
    close = np.interp(np.arange(total), [0, start, end - 1], [0.5, 1.0, size])[:, None]
    poses[:, 7:] = np.array(mode.closed) + close * np.array(mode.opening)
    things = np.zeros((total, 7))
    things[:, 3] = 1.0
    moved = end + counts["manipulation"]
    rise = np.interp(np.arange(total), [end - 1, moved - 1], [0.0, 1.0])
    things[:, :3] = rise[:, None] * np.array([0.0, 0.2, 0.1])
    poses[end:moved, :3] += things[end:moved, :3]
    if "releasing" in counts:
        poses[moved:, :3] += things[moved - 1, :3]
        back = np.linspace(0.0, 1.0, total - moved)
        poses[moved:, 7:] += back[:, None] * np.array(mode.opening)
    npad = len(mode.pads)
    return GraspRecording(
        grip=grip, object="thing", trial=trial, provenance="test", frame_rate=frame_rate,
        hand_poses=poses, object_poses=things, phases=phases, contact_bones=mode.bones,
        contact_local=np.full((npad, 3), 0.01), contact_points=np.full((npad, 3), 0.02),
        contact_normals=np.tile([0.0, 0.0, 1.0], (npad, 1)),
    )  # fmt: skip
