from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.results import evaluate_results


@pytest.fixture
def truth(rng: np.random.Generator) -> np.ndarray:
    """True keypoints of ten frames."""
    return rng.normal(size=(10, 21, 3)).astype(np.float32) * 0.1


def test_results_against_the_sequence(truth: np.ndarray, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    np.savez(run / "results.npz", keypoints=truth + np.float32([0.003, 0, 0]))
    np.savez(tmp_path / "sequence.npz", truth_keypoints=truth, depth=np.zeros((10, 2, 2)))
    for results in (run / "results.npz", run):
        for where in (tmp_path / "sequence.npz", tmp_path):
            result = evaluate_results(results, where)
            assert result.summary.mean_mm == pytest.approx(3.0, abs=1e-3)
            assert result.name == "run" and result.summary.frames == 10


def test_a_folder_stands_for_the_only_npz_in_it(truth: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", keypoints=truth)
    (tmp_path / "demo").mkdir()
    np.savez(tmp_path / "demo" / "fist.npz", truth_keypoints=truth)
    assert evaluate_results(tmp_path / "mine.npz", tmp_path / "demo").summary.mean_mm == 0.0


def test_results_may_carry_their_own_truth(truth: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", keypoints=truth, truth_keypoints=truth)
    assert evaluate_results(tmp_path / "a.npz").summary.mean_mm == 0.0
    np.savez(tmp_path / "b.npz", keypoints=truth)
    with pytest.raises(InputError, match="--truth"):
        evaluate_results(tmp_path / "b.npz")


def test_every_third_frame_is_measured_against_its_own_truth(
    truth: np.ndarray, tmp_path: Path
) -> None:
    np.savez(tmp_path / "truth.npz", truth_keypoints=truth)
    np.savez(tmp_path / "third.npz", keypoints=truth[::3], frame_index=np.arange(0, 10, 3))
    result = evaluate_results(tmp_path / "third.npz", tmp_path / "truth.npz")
    assert result.summary.mean_mm == 0.0
    assert result.frames.tolist() == [0, 3, 6, 9]
    np.savez(tmp_path / "late.npz", keypoints=truth[:2], frame_index=np.array([4, 10]))
    with pytest.raises(InputError, match="names frame 10"):
        evaluate_results(tmp_path / "late.npz", tmp_path / "truth.npz")


def test_frames_without_truth_are_left_out(truth: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", keypoints=truth)
    truth[4:6, 0] = np.nan
    np.savez(tmp_path / "truth.npz", truth_keypoints=truth)
    result = evaluate_results(tmp_path / "mine.npz", tmp_path / "truth.npz")
    assert result.frames.tolist() == [0, 1, 2, 3, 6, 7, 8, 9]
    assert result.summary.mean_mm == 0.0


def test_unusable_files_are_refused(truth: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", truth_keypoints=truth)
    np.savez(tmp_path / "short.npz", keypoints=truth[:7])
    with pytest.raises(InputError, match=r"7 frames.*10"):
        evaluate_results(tmp_path / "short.npz", tmp_path / "truth.npz")
    np.savez(tmp_path / "flat.npz", keypoints=truth.reshape(10, 63))
    with pytest.raises(InputError, match=r"\(10, 63\)"):
        evaluate_results(tmp_path / "flat.npz", tmp_path / "truth.npz")
    np.savez(tmp_path / "other.npz", poses=truth)
    with pytest.raises(InputError, match="no keypoints"):
        evaluate_results(tmp_path / "other.npz", tmp_path / "truth.npz")
    with pytest.raises(MissingFileError):
        evaluate_results(tmp_path / "none.npz", tmp_path / "truth.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "truth.npz").read_bytes()[:200])
    np.save(tmp_path / "single.npy", truth)
    (tmp_path / "single.npy").rename(tmp_path / "single.npz")
    np.savez(tmp_path / "pickled.npz", keypoints=np.array([{}], dtype=object))
    for name in ("cut", "single", "pickled"):
        with pytest.raises(DamagedFileError, match=name):
            evaluate_results(tmp_path / f"{name}.npz", tmp_path / "truth.npz")
