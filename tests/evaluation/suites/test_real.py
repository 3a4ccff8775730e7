"""Suite `real`: fingertips in pixels, trackers with and without a first pose, missing labels."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import DamagedFileError, InputError, MissingFileError
from handtrack.evaluation.metrics import MISSING_ERROR_MM
from handtrack.evaluation.nyu import nyu_joints36
from handtrack.evaluation.suites.real import real_suite, tip_errors
from handtrack.evaluation.suites.suite import SuiteResult, SuiteSettings, load_cases
from handtrack.hand.kinematics import keypoints
from handtrack.hand.skeleton import FINGERS, TIP_KEYPOINTS
from handtrack.synthesis.renderer import DepthRenderer
from oracles.automatic import AutomaticOracle
from oracles.scenes import SMALL_CAMERA, seen_poses, shaped_hand

CasesOf = Callable[[SuiteResult], dict[str, dict[str, Any]]]

UNIT = 1e-4
"""Metres per step of the images."""


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator, oracle: AutomaticOracle) -> Path:
    """Images of five poses, which the oracle knows: joints, tips three times, nothing."""
    hand = shaped_hand()
    poses = seen_poses(hand, rng, 5)
    depths = DepthRenderer(hand, SMALL_CAMERA, device="cpu").render(poses)
    for number, (name, pose, depth) in enumerate(
        zip(("joints", "tips-0", "tips-1", "tips-2", "bare"), poses, depths, strict=True)
    ):
        stored = np.rint(depth / UNIT).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{name}.png"), stored)
        facts: dict[str, Any] = {"camera": SMALL_CAMERA.to_dict(), "depth_unit_m": UNIT}
        pixels = SMALL_CAMERA.project(keypoints(hand, pose)[list(TIP_KEYPOINTS)])
        if name == "joints":
            facts |= {"hand": "right", "joints_nyu36_m": nyu_joints36(hand, pose).tolist()}
        elif name != "bare":
            named = dict(zip(FINGERS, pixels.tolist(), strict=True))
            facts["fingertips_px"] = {finger: named[finger] for finger in ("thumb", "index")}
        (tmp_path / f"{name}.json").write_text(json.dumps(facts))
        seen = stored.astype(np.float32) * np.float32(UNIT)
        oracle.learn(
            [DepthFrame(depth=seen, camera=SMALL_CAMERA, index=number, truth=FrameTruth(pose=pose))]
        )
    return tmp_path


@pytest.fixture
def data() -> dict[str, Any]:
    data = load_cases("real")
    data["quick"] = {
        "repeats": 3, "labelled": ["joints"], "fingertips": ["tips-0", "tips-1", "tips-2"],
        "pictured": ["bare"],
    }  # fmt: skip
    return data


def test_tips_are_measured_sideways_at_their_own_depth() -> None:
    points = np.full((21, 3), np.nan)
    points[8] = (0.02, -0.01, 0.4)
    points[4] = (0.0, 0.0, -0.1)
    pixel = SMALL_CAMERA.project(points[8])
    tips = {"index": pixel + np.array([3.0, 0.0]), "thumb": pixel, "little": pixel}
    errors = tip_errors(points, SMALL_CAMERA, tips)
    assert errors["index"] == pytest.approx(3.0 / SMALL_CAMERA.fx * 400)
    # A tip behind the camera, and one without a keypoint.
    assert errors["thumb"] == errors["little"] == MISSING_ERROR_MM
    tips = {"index": SMALL_CAMERA.project(points[8] + [0.003, 0.004, 0.0])}
    assert tip_errors(points, SMALL_CAMERA, tips)["index"] == pytest.approx(5.0)


def test_an_automatic_tracker_is_told_the_camera_alone(
    folder: Path,
    data: dict[str, Any],
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    cases_of: CasesOf,
) -> None:
    off = np.zeros(28)
    off[0] = 0.018

    def spoilt(number: int, pose: np.ndarray) -> np.ndarray | None:
        return {2: pose + off, 3: None}.get(number, pose)

    oracle.spoil = spoilt
    result = real_suite(replace(quick, data=folder), data)
    cases = cases_of(result)
    assert list(cases) == ["joints", "tips-0", "tips-1", "tips-2", "bare", "fingertips"]
    assert not oracle.starts and all(case["poses_given"] == 0 for case in cases.values())
    joints = cases["joints"]
    assert joints["shape"] == "mean" and joints["scale"] == 1.0 and joints["frames"] == 3
    assert joints["keypoint_error_mm"]["mean"] < 0.1 and joints["first_error_mm"] < 0.1
    assert "start_error_mm" not in joints
    assert result.errors_mm["joints, oracle"].shape == (3, 14)
    near, beside, none = (cases[f"tips-{k}"] for k in range(3))
    assert near["tips_within"] and near["found"] and near["tip_error_mm"]["max"] < 0.1
    assert beside["found"] and not beside["tips_within"]
    assert beside["tip_error_mm"]["thumb"] == pytest.approx(18.0, abs=0.1)
    assert not none["found"] and none["first_tip_error_mm"]["mean"] == MISSING_ERROR_MM
    total = cases["fingertips"]
    assert (total["images"], total["images_found"], total["images_within"]) == (3, 2, 1)
    assert total["frames"] == 9
    names = [overlay.name for overlay in result.overlays]
    assert len(names) == 2 * 5 and names[:2] == ["joints-oracle-first", "joints-oracle-fitted"]
    assert "tips 18.0 mm" in result.overlays[5].text
    assert "no pose given, 1.000 times the mean hand" in result.notes[0]


def test_its_shape_is_given_when_asked_for(
    folder: Path, data: dict[str, Any], quick: SuiteSettings, oracle: AutomaticOracle
) -> None:
    settings = replace(quick, data=folder, shape="given")
    joints = real_suite(settings, data).cases[0]
    assert joints["shape"] == "given" and joints["scale"] == pytest.approx(1.0, abs=0.02)
    assert joints["poses_given"] == 0 and not oracle.starts


def test_other_trackers_start_from_joints_and_leave_the_rest_out(
    folder: Path, data: dict[str, Any], quick: SuiteSettings, cases_of: CasesOf
) -> None:
    result = real_suite(replace(quick, data=folder, trackers=("model_based",)), data)
    cases = cases_of(result)
    assert list(cases) == ["joints"] and cases["joints"]["poses_given"] == 1
    assert cases["joints"]["start_error_mm"] < 3.0 and cases["joints"]["shape"] == "given"
    assert [overlay.name.split("-")[-1] for overlay in result.overlays] == ["start", "fitted"]
    assert result.errors_mm["joints, model_based"].shape == (4, 14)
    assert "not startable" in result.notes[-1] and "tips-0, tips-1" in result.notes[-1]


@pytest.mark.parametrize(
    ("labels", "error"),
    [
        ({}, InputError),
        ({"fingertips_px": {}}, InputError),
        ({"fingertips_px": {"toe": [1, 2]}}, DamagedFileError),
        ({"fingertips_px": {"thumb": [1]}}, DamagedFileError),
        ({"fingertips_px": {"thumb": ["left", "right"]}}, DamagedFileError),
    ],
)
def test_labels_that_are_no_fingertips_are_refused(
    labels: dict[str, Any],
    error: type[Exception],
    folder: Path,
    data: dict[str, Any],
    quick: SuiteSettings,
) -> None:
    facts = {"camera": SMALL_CAMERA.to_dict(), "depth_unit_m": UNIT}
    (folder / "tips-1.json").write_text(json.dumps(facts | labels))
    with pytest.raises(error, match=r"tips-1\.json"):
        real_suite(replace(quick, data=folder), data)


def test_missing_images_and_joints_are_named(
    folder: Path, data: dict[str, Any], quick: SuiteSettings
) -> None:
    data["quick"]["labelled"] = ["tips-0"]
    with pytest.raises(InputError, match="nyu36"):
        real_suite(replace(quick, data=folder), data)
    data["quick"]["labelled"] = ["nowhere"]
    with pytest.raises(MissingFileError, match="nowhere"):
        real_suite(replace(quick, data=folder), data)
