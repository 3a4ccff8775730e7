"""Suite `sequence`: recordings without labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handtrack.camera.frame import DepthFrame, FrameTruth
from handtrack.errors import InputError
from handtrack.evaluation.suites.suite import RecordedFrames, SuiteResult, SuiteSettings, run_suite
from handtrack.hand.shape import HandShape
from handtrack.synthesis.renderer import DepthRenderer
from oracles.automatic import AutomaticOracle
from oracles.scenes import SMALL_CAMERA, seen_poses, shaped_hand


def test_automatic_trackers_need_no_label(
    quick: SuiteSettings,
    oracle: AutomaticOracle,
    rng: np.random.Generator,
    cases_of: Callable[[SuiteResult], dict[str, dict[str, Any]]],
) -> None:
    poses = seen_poses(shaped_hand(), rng, 3)
    depths = DepthRenderer(shaped_hand(), SMALL_CAMERA, device="cpu").render(poses)
    frames = [
        DepthFrame(depth=depth, camera=SMALL_CAMERA, index=k, truth=FrameTruth(pose=pose))
        for k, (depth, pose) in enumerate(zip(depths, poses, strict=True))
    ]
    oracle.learn(frames)
    recorded = RecordedFrames(name="r", frames=frames, starts={}, side="right", shape=HandShape())
    settings = replace(quick, sequence=recorded)
    case = cases_of(run_suite("sequence", settings))["r"]
    assert case["states"]["tracking"] == 3 and case["poses_given"] == 0
    with pytest.raises(InputError, match="which model_based needs"):
        run_suite("sequence", replace(settings, trackers=("model_based",)))
