"""Plans of grasps: what they must hold, and files."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.grasp.plan import GraspPlan


def make_plan() -> GraspPlan:
    phases = ["reaching"] * 3 + ["closing"] * 4 + ["manipulation"] * 2 + ["releasing"]
    count = len(phases)
    hands, things = np.zeros((count, 28)), np.zeros((count, 7))
    hands[:, 3], things[:, 3] = 1.0, 1.0
    hands[:, 0] = np.arange(count)
    return GraspPlan(
        grip="tripod", times=0.1 * np.arange(count), hand_poses=hands, object_poses=things,
        phases=np.array(phases), contact_bones=np.array([3, 6]),
        contact_local=np.ones((2, 3)), contact_points=np.eye(3)[:2],
        contact_normals=np.eye(3)[:2], feasible=True, costs={"contact": 1.5, "quality": 0.25},
    )  # fmt: skip


def test_the_grasp_is_the_last_frame_of_closing() -> None:
    plan = make_plan()
    assert plan.grasp_frame == 6
    assert plan.of_phase("manipulation").tolist() == [7, 8]


def test_a_saved_plan_is_read_back_as_it_was(tmp_path: Path) -> None:
    plan = make_plan()
    plan.save(tmp_path / "plan.npz")
    back = GraspPlan.load(tmp_path / "plan.npz")
    for f in fields(GraspPlan):
        mine, other = getattr(plan, f.name), getattr(back, f.name)
        if isinstance(mine, np.ndarray):
            np.testing.assert_array_equal(mine, other)
        else:
            assert mine == other, f.name


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"hand_poses": np.zeros((10, 27))}, r"hand_poses has shape \(10, 27\); expected \(10, 28"),
        ({"contact_normals": np.zeros((1, 3))}, "contact_normals"),
        ({"times": np.zeros(10)}, "must rise"),
        ({"phases": np.array(["closing"] * 9 + ["waving"])}, "'waving' is unknown"),
        ({"phases": np.array(["closing"] * 5 + ["reaching"] * 5)}, "out of order"),
        ({"contact_bones": np.array([3, 16])}, "bone that does not exist"),
        ({"object_poses": np.full((10, 7), np.nan)}, "not finite"),
    ],
    ids=["shape", "normals", "times", "phase", "order", "bone", "nan"],
)
def test_arrays_that_do_not_fit_are_refused(change: dict, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        replace(make_plan(), **change)


def test_files_that_are_no_plan_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no grasp plan at"):
        GraspPlan.load(tmp_path / "nothing.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", format_version=1)
    np.savez(tmp_path / "newer.npz", format_version=9)
    for name in ("text.npz", "other.npz", "newer.npz"):
        with pytest.raises(DamagedFileError, match=name):
            GraspPlan.load(tmp_path / name)
