from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.protocols import (
    ICVL,
    NYU,
    PROTOCOLS,
    Protocol,
    evaluate_predictions,
    find_truth,
    protocol_named,
    read_uvd,
    uvd_to_xyz,
    write_uvd,
    xyz_to_uvd,
)

SMALL = replace(NYU, frames=range(4), truth_file="truth.txt")


@pytest.fixture
def truth_uvd(rng: np.random.Generator, tmp_path: Path) -> np.ndarray:
    """True joints of the small protocol, also written to truth.txt."""
    uvd = rng.uniform((100, 100, 600), (400, 300, 900), (4, 14, 3)).round(3)
    write_uvd(tmp_path / "truth.txt", uvd, SMALL)
    return uvd


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=list(PROTOCOLS))
def test_protocols_are_consistent(protocol: Protocol) -> None:
    assert len(protocol.joints) == len(set(protocol.joints)) == len(protocol.source_joints)
    assert protocol_named(protocol.name) is protocol
    assert protocol.frames.start == 0


def test_back_projection_uses_the_camera_and_millimetres() -> None:
    # One pixel right of and two below the centre at 588.03 mm.
    xyz = uvd_to_xyz([321.0, 242.0, 588.03], NYU)
    assert xyz == pytest.approx([0.001, 2 * 0.58803 / 587.07, 0.58803], rel=1e-12)
    assert xyz_to_uvd(xyz, NYU) == pytest.approx([321.0, 242.0, 588.03])


@pytest.mark.data
@pytest.mark.parametrize(
    ("method", "mean_mm", "within"),
    [
        ("DeepPrior", 20.750, (0.16275, 0.36222, 0.49237)),
        ("V2V-PoseNet", 8.419, (0.71243, 0.83119, 0.88088)),
    ],
)
def test_published_results_on_nyu_are_reproduced(
    recordings: Path, method: str, mean_mm: float, within: tuple[float, ...]
) -> None:
    result = evaluate_predictions(recordings / "published" / f"nyu_{method}.txt", NYU)
    assert round(result.summary.mean_mm, 3) == mean_mm
    assert tuple(result.summary.success_rate.values()) == pytest.approx(within, abs=1e-5)
    assert result.summary.frames == 8252 and result.errors_mm.shape == (8252, 14)
    assert result.summary.missing_rate == 0.0
    assert np.mean(list(result.joint_means_mm.values())) == pytest.approx(result.summary.mean_mm)


@pytest.mark.data
def test_truth_of_nyu_is_its_annotation(recordings: Path) -> None:
    uvd = read_uvd(recordings / NYU.truth_file, NYU)
    with np.load(recordings / "nyu_test_joints36.npz") as data:
        joints = data["joints"][:, list(NYU.source_joints)]
    # The text file has three decimals: a hundredth of a millimetre at most.
    assert np.abs(uvd_to_xyz(uvd, NYU) - joints).max() < 6e-5
    assert len(uvd) == len(NYU.frames)


@pytest.mark.data
def test_truth_of_icvl_is_a_hand(recordings: Path) -> None:
    xyz = uvd_to_xyz(read_uvd(recordings / ICVL.truth_file, ICVL), ICVL)
    assert len(xyz) == len(ICVL.frames)
    at = {name: k for k, name in enumerate(ICVL.joints)}
    for finger in ("thumb", "index", "middle", "ring", "little"):
        bone = xyz[:, at[f"{finger}_middle"]] - xyz[:, at[f"{finger}_root"]]
        length = np.linalg.norm(bone, axis=1)
        assert 0.01 < np.median(length) < 0.06
    # The wrist side of the palm is far from the fingertips when the hand is open.
    middle = np.linalg.norm(xyz[:, at["middle_tip"]] - xyz[:, at["palm"]], axis=1)
    assert 0.09 < np.percentile(middle, 95) < 0.16


def test_errors_are_measured_in_space(truth_uvd: np.ndarray, tmp_path: Path) -> None:
    predicted = truth_uvd.copy()
    predicted[0, 3, 2] += 30.0
    write_uvd(tmp_path / "mine.txt", predicted, SMALL)
    result = evaluate_predictions(tmp_path / "mine.txt", SMALL)
    u, v = truth_uvd[0, 3, :2] - (320.0, 240.0)
    # Along the pixel's ray, longer than along the optical axis.
    expected = 30.0 * np.sqrt(1 + (u / 588.03) ** 2 + (v / 587.07) ** 2)
    assert result.errors_mm[0, 3] == pytest.approx(expected, rel=1e-6)
    assert np.count_nonzero(result.errors_mm > 1e-3) == 1
    assert result.name == "mine" and result.frames.tolist() == [0, 1, 2, 3]


def test_nan_marks_a_missing_joint_and_commas_are_fine(
    truth_uvd: np.ndarray, tmp_path: Path
) -> None:
    lines = [",".join(f"{x}" for x in frame.ravel()) for frame in truth_uvd]
    lines[2] = lines[2].replace(lines[2].split(",")[0], "nan", 1)
    (tmp_path / "mine.txt").write_text("\n".join(lines))
    result = evaluate_predictions(tmp_path / "mine.txt", SMALL)
    assert result.summary.missing_rate == 0.25
    assert result.summary.success_rate["40"] == 0.75


def test_truth_is_found_beside_or_above(truth_uvd: np.ndarray, tmp_path: Path) -> None:
    folder = tmp_path / "published"
    folder.mkdir()
    write_uvd(folder / "mine.txt", truth_uvd, SMALL)
    assert find_truth(folder / "mine.txt", SMALL) == (tmp_path / "truth.txt").resolve()
    assert evaluate_predictions(folder / "mine.txt", SMALL).summary.mean_mm < 1e-3
    with pytest.raises(MissingFileError, match="--truth"):
        evaluate_predictions(folder / "mine.txt", replace(SMALL, truth_file="other.txt"))
    elsewhere = evaluate_predictions(
        folder / "mine.txt", replace(SMALL, truth_file="other.txt"), tmp_path / "truth.txt"
    )
    assert elsewhere.summary.frames == 4


def test_fewer_frames_need_the_option(truth_uvd: np.ndarray, tmp_path: Path) -> None:
    write_uvd(tmp_path / "mine.txt", truth_uvd[:3], SMALL)
    with pytest.raises(InputError, match=r"3 frames, but protocol nyu has 4.*--partial"):
        evaluate_predictions(tmp_path / "mine.txt", SMALL)
    assert evaluate_predictions(tmp_path / "mine.txt", SMALL, partial=True).summary.frames == 3
    write_uvd(tmp_path / "more.txt", np.concatenate([truth_uvd, truth_uvd]), SMALL)
    with pytest.raises(InputError, match=r"8 frames, but protocol nyu has 4$"):
        evaluate_predictions(tmp_path / "more.txt", SMALL, partial=True)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("1 2 3\n4 5 6\n", InputError, "3 numbers per line.*14 joints: 42 numbers"),
        ("1 2 3\n4 5\n", DamagedFileError, "not a table"),
        ("one two three\n", DamagedFileError, "not a table"),
        ("", DamagedFileError, "no frames"),
        ("\x00\xff", DamagedFileError, "not a table"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_bad_files_give_one_line_that_says_why(
    text: str, error: type[Exception], words: str, tmp_path: Path
) -> None:
    (tmp_path / "bad.txt").write_bytes(text.encode("latin-1"))
    with pytest.raises(error, match=words) as caught:
        read_uvd(tmp_path / "bad.txt", NYU)
    assert "\n" not in str(caught.value)


def test_missing_files_and_unknown_protocols_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nothing\.txt"):
        read_uvd(tmp_path / "nothing.txt", NYU)
    with pytest.raises(InputError, match="nyu, icvl"):
        protocol_named("msra")
    with pytest.raises(InputError, match=r"\(n, 14, 3\)"):
        write_uvd(tmp_path / "x.txt", np.zeros((4, 16, 3)), NYU)
