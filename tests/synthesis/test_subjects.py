"""Unseen subjects: what is in the file, and that the shape space does not hold them exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError
from handtrack.synthesis.subjects import UnseenSubjects
from oracles.scenes import hand_model


def test_twenty_hands_of_the_size_of_people() -> None:
    subjects, model = UnseenSubjects.load(), hand_model()
    assert len(subjects) == 20
    palms = np.array([subjects.hand(k, model).bone_lengths[0] for k in range(20)])
    assert 0.07 < palms.min() < palms.max() < 0.125 and palms.std() > 0.003


def test_the_shape_space_does_not_hold_them() -> None:
    subjects, model = UnseenSubjects.load(), hand_model()
    basis = model.offset_basis.reshape(-1, model.nbeta)
    for number in range(len(subjects)):
        rest = (subjects.offsets[number] - model.offset_mean).ravel()
        left = rest - basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
        assert np.linalg.norm(left.reshape(-1, 3), axis=1).mean() > 5e-5


def test_a_left_hand_is_the_mirror_image() -> None:
    subjects, model = UnseenSubjects.load(), hand_model()
    right, left = (subjects.hand(3, model, side=side) for side in ("right", "left"))
    np.testing.assert_allclose(right.bone_lengths, left.bone_lengths)
    assert left.side == "left"


def test_wrong_numbers_models_and_files_are_refused(tmp_path: Path) -> None:
    subjects, model = UnseenSubjects.load(), hand_model()
    with pytest.raises(InputError, match="subject 20 of 20"):
        subjects.hand(20, model)
    with pytest.raises(InputError, match="draw them again"):
        subjects.hand(0, replace(model, offset_mean=model.offset_mean[:-1]))
    np.savez(tmp_path / "other.npz", a=1)
    with pytest.raises(DamagedFileError, match="no subjects"):
        UnseenSubjects.load(tmp_path / "other.npz")
