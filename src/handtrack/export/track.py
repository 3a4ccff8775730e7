"""One hand through one sequence, as read from `results.npz`: what every format is written from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.run_record import FORMAT_VERSION
from handtrack.files import UNREADABLE
from handtrack.hand.model import HandModel, ShapedHand
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, check_side
from handtrack.hand.skeleton import KEYPOINTS, NKEYPOINT, NQ, POSE
from handtrack.tracking.result import TrackState

Float = NDArray[np.float64]

DEFAULT_INTERVAL = 1.0 / 30.0
"""Time between frames where the time stamps do not tell it [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """What a tracker said about one hand in n frames, in order."""

    source: str
    """Where the depth came from."""
    hand: ShapedHand
    """The hand that was tracked, at the size it had in the end."""
    shape: HandShape
    """Its shape."""
    frames: NDArray[np.int64]
    """Number of each frame in its sequence, shape (n,)."""
    times: Float
    """Time stamp of each frame [s], shape (n,)."""
    states: tuple[TrackState, ...]
    """State of each frame."""
    problems: tuple[str, ...]
    """What was wrong with each frame, empty text for nothing."""
    depth_errors: Float
    """Depth error E_d of each frame [m], shape (n,); NaN where there is none."""
    poses: Float
    """Pose of each frame, shape (n, 28); NaN with NO_HAND, an old one with LOST."""
    keypoints: Float
    """Keypoints of each frame [m], camera frame, shape (n, 21, 3); NaN with NO_HAND."""
    keypoint_std: Float
    """One sigma of each keypoint [m], shape (n, 21); NaN where it is not known."""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def side(self) -> Side:
        """Which hand."""
        return self.hand.side

    @property
    def followed(self) -> NDArray[np.bool_]:
        """Frames whose pose explains their depth, shape (n,)."""
        return np.array([state.sure for state in self.states])

    @property
    def interval(self) -> float:
        """Mean time between frames [s]."""
        span = float(self.times[-1] - self.times[0])
        return span / (len(self) - 1) if span > 0.0 else DEFAULT_INTERVAL

    @property
    def sizes(self) -> Float:
        """Size of the hand in each frame over that of `hand`, shape (n,); NaN with NO_HAND.

        A tracker that does not know the hand corrects its size while it follows it, and the results
        hold the last one; the keypoints still tell those before.
        """
        reach = self.keypoints[:, KEYPOINTS.index("middle_mcp")] - self.keypoints[:, 0]
        return np.linalg.norm(reach, axis=1) / self.hand.bone_lengths[0]

    def at_size(self, points: Float) -> Float:
        """Points of `hand` in its poses, shape (n, k, 3), on the hand of each frame's size [m]."""
        wrist = self.poses[:, None, :3]
        return wrist + self.sizes[:, None, None] * (points - wrist)

    def held_poses(self) -> Float:
        """Poses without gaps, shape (n, 28), for formats that cannot leave a frame out.

        A frame that was not followed has the pose of the last one that was; before the first
        followed frame the hand stands where it will be found.

        Raises:
            InputError: No frame was followed.
        """
        followed = np.flatnonzero(self.followed)
        if not len(followed):
            raise InputError(
                f"{self.source or 'the results'}: the hand was followed in none of {len(self)} "
                "frames, so there is no motion to write; csv, jsonl and npz say what went wrong"
            )
        last = np.searchsorted(followed, np.arange(len(self)), side="right") - 1
        return self.poses[followed[np.maximum(last, 0)]]


def read_track(path: str | Path, *, model: HandModel | None = None) -> Track:
    """Read the results of `handtrack track`.

    Args:
        path: results.npz, or the folder that holds it.
        model: The hand model they were tracked with; the one that comes with handtrack when None.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: The file cannot be read, or is not the results of a run.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "results.npz"
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; handtrack track writes results.npz")
    model = model or HandModel.load()
    try:
        with np.load(path, allow_pickle=False) as data:
            version = int(data["format_version"])
            if version != FORMAT_VERSION:
                raise ValueError(f"format {version}; this version reads {FORMAT_VERSION}")
            shape = HandShape(
                alpha=data["shape_alpha"], beta=data["shape_beta"], scale=float(data["scale"])
            )
            side = check_side(str(data["side"]))
            track = Track(
                source=str(data["source"]),
                hand=model.shaped(shape, side=side),
                shape=shape,
                frames=data["frame_index"].astype(np.int64),
                times=data["time"].astype(np.float64),
                states=tuple(map(TrackState, data["state"].tolist())),
                problems=tuple(data["problem"].tolist()),
                depth_errors=data["depth_error"].astype(np.float64),
                poses=data["pose"].astype(np.float64),
                keypoints=data["keypoints"].astype(np.float64),
                keypoint_std=data["keypoint_std"].astype(np.float64),
            )
            names = tuple(data["pose_names"].tolist()), tuple(data["keypoint_names"].tolist())
        if names != (POSE, KEYPOINTS):
            raise ValueError("poses or keypoints are named otherwise than here")
        _check(track)
    except UNREADABLE as error:
        raise DamagedFileError(
            f"{path} is not the results.npz of handtrack track: {error}"
        ) from error
    return track


def _check(track: Track) -> None:
    """Raise ValueError where arrays do not fit together."""
    count = len(track.frames)
    if not count:
        raise ValueError("no frames")
    expected = {
        "times": (count,), "states": (count,), "problems": (count,), "depth_errors": (count,),
        "poses": (count, NQ), "keypoints": (count, NKEYPOINT, 3),
        "keypoint_std": (count, NKEYPOINT),
    }  # fmt: skip
    for name, shape in expected.items():
        found = np.shape(getattr(track, name))
        if found != shape:
            raise ValueError(f"{name} have shape {found}; expected {shape}")
    if not np.isfinite(track.times).all():
        raise ValueError("a time stamp is not finite")
    known = [state is not TrackState.NO_HAND for state in track.states]
    if not np.isfinite(track.poses[known]).all() or not np.isfinite(track.keypoints[known]).all():
        raise ValueError("a pose or its keypoints are not finite, and the state does not say so")
    if (np.linalg.norm(track.poses[known, 3:7], axis=1) < 0.5).any():
        raise ValueError("a quaternion is not of unit length")
