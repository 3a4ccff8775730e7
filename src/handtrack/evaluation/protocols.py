"""Published test protocols: which frames, which joints, which camera, which file format.

Results of most depth-based methods are published as text files with one line per frame and ``u v
d`` per joint: pixel coordinates and depth in millimetres (the collection
github.com/xinghaochen/awesome-hand-pose-estimation holds many). Errors are measured in 3D, after
back-projection with the protocol's camera; measuring in the u v d numbers as they are, or with
another camera, gives other values than those in the papers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtrack.camera.camera import Camera
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.metrics import AccuracySummary, keypoint_errors, summarize


@dataclass(frozen=True, kw_only=True, slots=True)
class Protocol:
    """One published way of measuring on one data set."""

    name: str
    """Name on the command line."""
    title: str
    """Name for tables."""
    camera: Camera
    """Camera of the depth images; back-projects u v d."""
    joints: tuple[str, ...]
    """Names of the evaluated joints, in the order of the files' columns."""
    source_joints: tuple[int, ...]
    """Index of each evaluated joint in the data set's own annotation."""
    frames: range
    """Frames of the data set's test part that count, 0-based; line i of a file is `frames[i]`."""
    depth_unit_m: float = 1e-3
    """Unit of the files' d column [m]."""
    truth_file: str
    """Usual name of the file with the true joints, looked for beside the predictions."""
    citation: str
    """The data set's paper, and where the protocol comes from."""


NYU = Protocol(
    name="nyu",
    title="NYU, 14 joints",
    camera=Camera(width=640, height=480, fx=588.03, fy=587.07, cx=320.0, cy=240.0),
    joints=(
        "little_tip", "little_inner", "ring_tip", "ring_inner",
        "middle_tip", "middle_inner", "index_tip", "index_inner",
        "thumb_tip", "thumb_middle", "thumb_inner",
        "wrist_little_side", "wrist_thumb_side", "palm",
    ),
    source_joints=(0, 3, 6, 9, 12, 15, 18, 21, 24, 25, 27, 30, 31, 32),
    frames=range(8252),
    truth_file="nyu_test_groundtruth_uvd14.txt",
    citation=(
        "Tompson et al., Real-time continuous pose recovery of human hands using convolutional "
        "networks, TOG 2014; 14 of its 36 joints as in Oberweger et al., Hands deep in deep "
        "learning for hand pose estimation, CVWW 2015"
    ),
)  # fmt: skip
"""NYU test set, both subjects, first camera, 14 joints."""

ICVL = Protocol(
    name="icvl",
    title="ICVL, 16 joints",
    camera=Camera(width=320, height=240, fx=240.99, fy=240.96, cx=160.0, cy=120.0),
    joints=(
        "palm", *(f"{finger}_{joint}" for finger in ("thumb", "index", "middle", "ring", "little")
                  for joint in ("root", "middle", "tip")),
    ),
    source_joints=tuple(range(16)),
    frames=range(1596),
    truth_file="icvl_test_groundtruth_uvd16.txt",
    citation=(
        "Tang et al., Latent regression forest: structured estimation of 3D articulated hand "
        "posture, CVPR 2014"
    ),
)  # fmt: skip
"""ICVL test set, both sequences, all 16 joints."""

PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in (NYU, ICVL)}
"""Protocols by their name on the command line."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """Predictions measured against the truth."""

    name: str
    """What was measured: usually the stem of the file of predictions."""
    protocol: str
    """Title of the protocol, or of the kind of file."""
    joints: tuple[str, ...]
    """Names of the measured joints."""
    errors_mm: NDArray[np.float64]
    """Error of every joint [mm], shape (n, njoint)."""
    summary: AccuracySummary
    """The usual numbers over all frames."""
    frames: NDArray[np.intp]
    """Frame number of each row of `errors_mm`, shape (n,)."""

    @property
    def joint_means_mm(self) -> dict[str, float]:
        """Mean error of each joint over all frames [mm]."""
        return dict(zip(self.joints, self.errors_mm.mean(axis=0).tolist(), strict=True))


def measure(
    name: str,
    protocol: str,
    joints: Sequence[str],
    predicted: ArrayLike,
    truth: ArrayLike,
    frames: ArrayLike | None = None,
) -> Evaluation:
    """Measure predicted positions and keep the error of every joint.

    Args:
        name: What is measured.
        protocol: By which protocol.
        joints: Names of the joints.
        predicted: Predicted positions [m], shape (n, njoint, 3); non-finite entries mean "no
            prediction".
        truth: True positions [m], same shape, finite.
        frames: Frame numbers, shape (n,); 0, 1, 2, ... without.
    """
    errors = keypoint_errors(predicted, truth)
    return Evaluation(
        name=name,
        protocol=protocol,
        joints=tuple(joints),
        errors_mm=errors,
        summary=summarize(predicted, truth),
        frames=np.arange(len(errors)) if frames is None else np.asarray(frames, dtype=np.intp),
    )


def protocol_named(name: str) -> Protocol:
    """Look a protocol up by its name.

    Raises:
        InputError: There is no such protocol.
    """
    try:
        return PROTOCOLS[name]
    except KeyError:
        known = ", ".join(PROTOCOLS)
        raise InputError(f"no protocol is called {name!r}: choose one of {known}") from None


def uvd_to_xyz(uvd: ArrayLike, protocol: Protocol) -> NDArray[np.float64]:
    """Back-project the numbers of a protocol file.

    Args:
        uvd: Pixel coordinates u, v and depth d in the protocol's unit, shape (..., 3).
        protocol: Gives camera and unit.

    Returns:
        Positions [m], shape (..., 3), camera frame, float64.
    """
    uvd = np.asarray(uvd, dtype=np.float64)
    return protocol.camera.unproject(uvd[..., :2], uvd[..., 2] * protocol.depth_unit_m)


def xyz_to_uvd(xyz: ArrayLike, protocol: Protocol) -> NDArray[np.float64]:
    """Project positions into the numbers of a protocol file; the inverse of `uvd_to_xyz`.

    Args:
        xyz: Positions [m], shape (..., 3), camera frame.
        protocol: Gives camera and unit.

    Returns:
        Pixel coordinates u, v and depth d in the protocol's unit, shape (..., 3), float64.
    """
    xyz = np.asarray(xyz, dtype=np.float64)
    depth = xyz[..., 2:] / protocol.depth_unit_m
    return np.concatenate([protocol.camera.project(xyz), depth], axis=-1)


def read_uvd(path: str | Path, protocol: Protocol) -> NDArray[np.float64]:
    """Read a file with one frame per line and u v d per joint.

    Numbers are separated by spaces, tabs or commas; ``nan`` marks a joint without a prediction.

    Args:
        path: Text file.
        protocol: Gives the number of joints.

    Returns:
        u, v [pixels] and d in the protocol's unit, shape (n, njoint, 3), float64.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: The file is not a table of numbers.
        InputError: The number of columns does not fit the protocol.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file of predictions or true joints")
    try:
        text = path.read_text(encoding="ascii")
        table = np.loadtxt(text.replace(",", " ").splitlines(), dtype=np.float64, ndmin=2)
    except (ValueError, OSError) as error:
        raise DamagedFileError(
            f"{path}: not a table of numbers with one frame per line ({str(error).splitlines()[0]})"
        ) from None
    njoint = len(protocol.joints)
    if table.size == 0:
        raise DamagedFileError(f"{path}: the file holds no frames")
    if table.shape[1] != 3 * njoint:
        raise InputError(
            f"{path}: {table.shape[1]} numbers per line, but protocol {protocol.name} has "
            f"{njoint} joints: {3 * njoint} numbers (u v d per joint)"
        )
    return table.reshape(-1, njoint, 3)


def write_uvd(path: str | Path, uvd: ArrayLike, protocol: Protocol) -> None:
    """Write predictions as a protocol file, three decimals per number.

    Args:
        path: Text file to write.
        uvd: u, v [pixels] and d in the protocol's unit, shape (n, njoint, 3).
        protocol: Gives the number of joints.
    """
    uvd = np.asarray(uvd, dtype=np.float64)
    if uvd.ndim != 3 or uvd.shape[1:] != (len(protocol.joints), 3):
        raise InputError(
            f"predictions have shape {uvd.shape}, protocol {protocol.name} needs "
            f"(n, {len(protocol.joints)}, 3)"
        )
    np.savetxt(path, uvd.reshape(len(uvd), -1), fmt="%.3f")


def find_truth(predictions: str | Path, protocol: Protocol) -> Path:
    """Find the protocol's truth file in the folder of the predictions or the one above.

    Raises:
        MissingFileError: It is in neither.
    """
    folder = Path(predictions).resolve().parent
    for place in (folder, folder.parent):
        if (place / protocol.truth_file).is_file():
            return place / protocol.truth_file
    raise MissingFileError(
        f"{protocol.truth_file} is neither in {folder} nor in {folder.parent}: "
        "name the file with the true joints by --truth"
    )


def evaluate_predictions(
    predictions: str | Path,
    protocol: Protocol,
    truth: str | Path | None = None,
    *,
    partial: bool = False,
) -> Evaluation:
    """Measure a published file of predictions by a protocol.

    Args:
        predictions: File with one frame per line and u v d per joint.
        protocol: The protocol it follows.
        truth: File with the true joints in the same format; searched for beside the predictions
            without.
        partial: Accept fewer frames than the protocol has; the lines are then its first frames.

    Raises:
        MissingFileError: A file is not there.
        DamagedFileError: A file cannot be read.
        InputError: The number of frames or joints does not fit.
    """
    predictions = Path(predictions)
    predicted = read_uvd(predictions, protocol)
    truth_path = find_truth(predictions, protocol) if truth is None else Path(truth)
    true = read_uvd(truth_path, protocol)
    expected = len(protocol.frames)
    if len(true) != expected:
        raise InputError(
            f"{truth_path}: {len(true)} frames, but protocol {protocol.name} has {expected}"
        )
    if not np.isfinite(true).all():
        raise DamagedFileError(f"{truth_path}: some true joints are not finite numbers")
    if len(predicted) > expected or (len(predicted) < expected and not partial):
        hint = (
            "; pass --partial to measure the first frames only" if len(predicted) < expected else ""
        )
        raise InputError(
            f"{predictions}: {len(predicted)} frames, but protocol {protocol.name} has "
            f"{expected}{hint}"
        )
    count = len(predicted)
    return measure(
        predictions.stem,
        protocol.title,
        protocol.joints,
        uvd_to_xyz(predicted, protocol),
        uvd_to_xyz(true[:count], protocol),
        np.asarray(protocol.frames[:count]),
    )
