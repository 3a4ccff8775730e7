"""NPZ: plain arrays for NumPy, with the frame of every bone worked out."""

from __future__ import annotations

import io

import numpy as np

from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames
from handtrack.hand.skeleton import ANGLES, BONE_PARENTS, BONES, KEYPOINTS

VERSION = 1
"""Version of the layout."""


def arrays(track: Track) -> bytes:
    """Every frame; what is not known is NaN."""
    rotations, origins = bone_frames(track.hand, track.poses)
    transforms = np.zeros((*origins.shape[:-1], 4, 4))
    transforms[..., :3, :3] = rotations
    transforms[..., :3, 3] = track.at_size(origins)
    transforms[..., 3, 3] = 1.0
    transforms[np.isnan(track.poses).any(axis=1)] = np.nan
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        format_version=VERSION,
        source=track.source,
        side=track.side,
        shape_alpha=track.shape.alpha,
        shape_beta=track.shape.beta,
        scale=track.shape.scale,
        frame_index=track.frames,
        time=track.times,
        state=np.array([state.value for state in track.states]),
        followed=track.followed,
        size=track.sizes,
        depth_error=track.depth_errors,
        translation=track.poses[:, :3],
        orientation=track.poses[:, 3:7],
        angles=track.poses[:, 7:],
        angle_names=np.array(ANGLES),
        keypoints=track.keypoints,
        keypoint_std=track.keypoint_std,
        keypoint_names=np.array(KEYPOINTS),
        T_camera_bone=transforms,
        bone_names=np.array(BONES),
        bone_parents=np.array(BONE_PARENTS),
    )
    return buffer.getvalue()
