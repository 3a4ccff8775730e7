"""Measuring our own results: the tracker's `results.npz` against the truth of the sequence."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.protocols import Evaluation, measure
from handtrack.hand.skeleton import KEYPOINTS, NKEYPOINT

TITLE = "21 keypoints"
"""What stands in the place of a protocol's title."""

FRAME_NAMES: tuple[str, ...] = ("frame_index", "frame", "index")
"""Names under which a results file may say which frame of the sequence each row is."""


def evaluate_results(results: str | Path, truth: str | Path | None = None) -> Evaluation:
    """Measure tracked keypoints against the true ones.

    Row i of the results is frame i of the sequence unless the results carry frame numbers, so
    results of every n-th frame can be measured against the whole sequence. Frames whose true
    keypoints are not finite (no hand in view, no truth) are left out.

    Args:
        results: .npz file with ``keypoints`` [m], shape (n, 21, 3), or the folder that holds
            results.npz.
        truth: .npz file with ``truth_keypoints`` (or ``keypoints``) [m], shape (nframe, 21, 3);
            without it the results file itself must have ``truth_keypoints``.

    Raises:
        MissingFileError: A file is not there.
        DamagedFileError: A file cannot be read.
        InputError: A file lacks the arrays, or the frames do not match.
    """
    results = _file(results, "results.npz")
    predicted = _array(results, ("keypoints",))
    assert predicted is not None
    if truth is None:
        true = _array(results, ("truth_keypoints",), required=False)
        if true is None:
            raise InputError(
                f"{results} holds no truth_keypoints: name the sequence with the truth by --truth"
            )
        truth = results
    else:
        truth = _file(truth, "sequence.npz")
        true = _array(truth, ("truth_keypoints", "keypoints"))
        assert true is not None
    frames = _frames(results, len(predicted))
    if frames is None:
        if len(predicted) != len(true):
            raise InputError(
                f"{results} has {len(predicted)} frames and {truth} has {len(true)}: they must be "
                f"the same frames, or the results must say which by {FRAME_NAMES[0]}"
            )
        frames = np.arange(len(true))
    elif truth != results:
        if frames.max() >= len(true) or frames.min() < 0:
            raise InputError(
                f"{results} names frame {int(frames.max())}, but {truth} has {len(true)} frames"
            )
        true = true[frames]
    known = np.isfinite(true).all(axis=(1, 2))
    if not known.any():
        raise InputError(f"{truth} has no frame with finite true keypoints")
    name = results.stem if results.name != "results.npz" else results.resolve().parent.name
    return measure(name, TITLE, KEYPOINTS, predicted[known], true[known], frames[known])


def _file(path: str | Path, default: str) -> Path:
    """The file itself; in a folder the one of the usual name, or the only .npz there."""
    path = Path(path)
    if path.is_dir():
        held = sorted(path.glob("*.npz"))
        path = held[0] if len(held) == 1 else path / default
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file")
    return path


def _array(
    path: Path, names: tuple[str, ...], *, required: bool = True
) -> NDArray[np.float64] | None:
    """First of the named keypoint arrays of an .npz file, shape (n, 21, 3)."""
    content = _load(path, names)
    for name in names:
        if name in content:
            array = content[name]
            break
    else:
        if not required:
            return None
        raise InputError(f"{path} holds no {' or '.join(names)}")
    if (
        array.dtype.kind not in "fiu"
        or array.ndim != 3
        or array.shape[1:] != (NKEYPOINT, 3)
        or not len(array)
    ):
        raise InputError(
            f"{path}: {name} is {array.dtype} of shape {array.shape}, expected metres of shape "
            f"(n, {NKEYPOINT}, 3)"
        )
    return array.astype(np.float64)


def _frames(path: Path, count: int) -> NDArray[np.intp] | None:
    """Frame number of each row of the results, None where the file does not say."""
    content = _load(path, FRAME_NAMES)
    for name in FRAME_NAMES:
        if name in content:
            frames = content[name]
            if frames.shape != (count,) or frames.dtype.kind not in "iu":
                raise InputError(
                    f"{path}: {name} is {frames.dtype} of shape {frames.shape}, "
                    f"expected {count} whole numbers"
                )
            return frames.astype(np.intp)
    return None


def _load(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """The named arrays of an .npz file, as far as it has them."""
    try:
        data = np.load(path, allow_pickle=False)
        if not isinstance(data, np.lib.npyio.NpzFile):
            raise DamagedFileError(f"{path} is a single array, not an .npz file")
        with data:
            return {name: np.asarray(data[name]) for name in names if name in data.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        if isinstance(error, DamagedFileError):
            raise
        reason = (str(error).splitlines() or ["unreadable"])[0]
        raise DamagedFileError(f"{path} cannot be read as an .npz file ({reason})") from None
