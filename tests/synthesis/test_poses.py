"""Named poses: complete, inside limits, fingers apart, and the hand shapes they are named after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from handtrack.artifacts import artifact_path
from handtrack.errors import DamagedFileError, MissingFileError
from handtrack.hand.kinematics import keypoints
from handtrack.hand.model import HandModel
from handtrack.hand.skeleton import ANGLES
from handtrack.synthesis.collision import HandSpheres
from handtrack.synthesis.poses import POSES_FILE, load_poses

HAND = HandModel.load().shaped()
POSES = load_poses()
TIPS = {"thumb": 4, "index": 8, "middle": 12, "ring": 16, "little": 20}
STRAIGHT = {
    "A": "", "B": "index middle ring little", "D": "index", "F": "middle ring little",
    "H": "index middle", "I": "little", "K": "index middle", "L": "index", "S": "",
    "U": "index middle", "V": "index middle", "W": "index middle ring", "Y": "little",
    "1": "index", "2": "index middle", "3": "index middle", "4": "index middle ring little",
    "5": "index middle ring little", "6": "index middle ring", "7": "index middle little",
    "8": "index ring little", "9": "middle ring little", "fist": "", "point": "index",
}  # fmt: skip
"""Fingers that are straight in a sign; the others are not."""
TOUCH = {
    "D": "middle", "F": "index", "O": "index", "6": "little", "7": "ring", "8": "middle",
    "9": "index", "pinch": "index", "ok": "index",
}  # fmt: skip
"""Finger whose tip meets the thumb's."""


def points(name: str) -> np.ndarray:
    """Keypoints in the palm frame [m], shape (21, 3)."""
    return keypoints(HAND, np.concatenate([[0, 0, 0, 1, 0, 0, 0], POSES[name]]))


def angle(name: str, which: str) -> float:
    """One joint angle [degrees]."""
    return float(np.degrees(POSES[name][ANGLES.index(which)]))


def test_all_letters_and_digits_are_there_within_limits() -> None:
    assert set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789") <= set(POSES)
    for name, angles in POSES.items():
        assert angles.shape == (21,), name
        assert ((angles >= HAND.limits[:, 0]) & (angles <= HAND.limits[:, 1])).all(), name


def test_fingers_do_not_pass_through_each_other() -> None:
    spheres = HandSpheres.of(HAND)
    deep = {n: float(spheres.penetration(a)) for n, a in POSES.items()}
    assert max(deep.values()) < 0.005, max(deep, key=deep.__getitem__)
    through = np.zeros(21)
    through[ANGLES.index("index_mcp_abduction")] = np.radians(-20.0)
    through[ANGLES.index("middle_mcp_abduction")] = np.radians(20.0)
    assert spheres.penetration(through) > 0.005


@pytest.mark.parametrize("name", STRAIGHT)
def test_the_right_fingers_are_straight(name: str) -> None:
    straight = {f for f in TIPS if f != "thumb" and angle(name, f"{f}_pip_flexion") < 15}
    assert straight == set(STRAIGHT[name].split())


@pytest.mark.parametrize("name", TOUCH)
def test_the_thumb_meets_the_right_finger(name: str) -> None:
    tips = points(name)
    gaps = {f: np.linalg.norm(tips[TIPS["thumb"]] - tips[k]) for f, k in TIPS.items()}
    del gaps["thumb"]
    assert min(gaps, key=gaps.__getitem__) == TOUCH[name] or name == "O"
    # Tips are inside the flesh: skins touch at about twice a finger's radius.
    assert gaps[TOUCH[name]] < 0.025


def test_signs_that_differ_by_the_thumb_or_by_spreading() -> None:
    # Across the fingers lies the thumb farther out of the palm than beside them.
    assert points("S")[4, 1] > points("A")[4, 1]
    # From T to N to M it goes one finger farther to the little finger's side (-z).
    assert points("T")[4, 2] > points("N")[4, 2] + 0.01 > points("M")[4, 2] + 0.02
    spread = {n: np.linalg.norm(points(n)[8] - points(n)[12]) for n in "UV"}
    assert spread["V"] > 2 * spread["U"]
    # R crosses: seen from the palm the middle fingertip is on the thumb's side of the index'.
    assert points("R")[12, 2] > points("R")[8, 2] and points("R")[12, 1] < points("R")[8, 1]
    for a, b in (
        ("H", "U"),
        ("J", "I"),
        ("Z", "1"),
        ("P", "K"),
        ("Q", "G"),
        ("0", "O"),
        ("9", "F"),
    ):
        np.testing.assert_array_equal(POSES[a], POSES[b])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"tm_flexion", "tm_abduction"', '"tm_abduction", "tm_flexion"', r"\[angles\] is"),
        ("[poses.A]", "poses.A", "not a TOML file"),
        ("thumb = [-5,", "thumb = [-500,", "pose A: thumb_tm_flexion is -500 degrees"),
        ("thumb = [-5,", "thumb = [", "pose A: thumb is .* expected 5 numbers"),
        ("thumb = [-5,", "thumb = [nan,", "pose A has an angle that is not finite"),
        ("thumb = [-5,", 'thumb = ["x",', "pose A: thumb is"),
        ("thumb = [-5,", "toe = [-5,", "pose A has toe"),
        ('same_as = "V"', 'same_as = "VV"', "pose 2 is the same as 'VV'"),
        ('same_as = "V"', 'same_as = "Z"', "pose 2 is the same as 'Z'"),
    ],
)
def test_a_damaged_file_is_told(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = artifact_path(POSES_FILE).read_text("utf-8")
    assert old in text
    path = tmp_path / "poses.toml"
    path.write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(DamagedFileError, match=message):
        load_poses(path)


def test_a_missing_or_empty_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no poses at"):
        load_poses(tmp_path / "none.toml")
    text = artifact_path(POSES_FILE).read_text("utf-8")
    (tmp_path / "p.toml").write_text(text.split("[poses", maxsplit=1)[0], "utf-8")
    with pytest.raises(DamagedFileError, match="has no poses"):
        load_poses(tmp_path / "p.toml")
