"""Results of a hand that is found, followed, lost and found again; no tracker runs for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.evaluation.run_record import RunRecord
from handtrack.export.track import Track, read_track
from handtrack.fitting.uncertainty import FitInformation
from handtrack.hand.model import HandModel
from handtrack.hand.shape import HandShape
from handtrack.hand.side import Side, mirror_pose
from handtrack.synthesis.motion import Motion
from handtrack.tracking.result import HandResult, TrackState

CAMERA = Camera(width=32, height=24, fx=24.0, fy=24.0, cx=15.5, cy=11.5)

STATES = [
    *[TrackState.NO_HAND] * 2, *[TrackState.TRACKING] * 6, *[TrackState.LOST] * 3,
    TrackState.RECOVERED, *[TrackState.TRACKING] * 4,
]  # fmt: skip
"""State of each frame."""


def make_results(side: Side) -> list[HandResult]:
    """A subject's hand in recorded motion, with the states above."""
    model = HandModel.load()
    rng = np.random.default_rng(3)
    hand = model.shaped(unusual_shape(model), side=side)
    poses = Motion.load("recorded_hand_motion").take(877, 877 + 5 * len(STATES), 5).to_poses()
    if side == "left":
        poses = mirror_pose(poses)
    results: list[HandResult] = []
    for place, state in enumerate(STATES):
        pose = poses[place].copy()
        if state is TrackState.NO_HAND:
            pose = np.full(28, np.nan)
        elif state is TrackState.LOST:
            pose = results[-1].pose.copy()
        root = rng.normal(size=(27, 27)) * 100.0
        knowledge = FitInformation(
            hessian=root @ root.T, unexplained=0.2, area=0.01, spacing=0.004
        )  # fmt: skip
        results.append(
            HandResult(
                state=state,
                side=side,
                pose=pose,
                depth_error=np.nan if state is TrackState.NO_HAND else 0.003,
                hand=hand,
                problem="nothing there" if state is TrackState.NO_HAND else None,
                timings={"total": 1.0},
                information=knowledge if state.sure else None,
            )
        )
    return results


def unusual_shape(model: HandModel) -> HandShape:
    """A shape that is far from the mean in every respect."""
    shape = model.sample_shape(np.random.default_rng(3), deviation=1.5)
    return HandShape(alpha=shape.alpha, beta=shape.beta, scale=1.07)


def make_frame(place: int) -> DepthFrame:
    """Frame of the sequence; the clock is uneven, as that of a camera that drops frames."""
    time = 100.0 + place / 30.0 + (0.011 if place % 3 == 1 else 0.0)
    return DepthFrame(depth=np.zeros((24, 32), np.float32), camera=CAMERA, time=time, index=place)


@pytest.fixture(scope="session", params=["right", "left"])
def side(request: pytest.FixtureRequest) -> Side:
    """Both hands."""
    return request.param


@pytest.fixture(scope="session")
def hand_results(side: Side) -> list[HandResult]:
    """The results of the tracker."""
    return make_results(side)


@pytest.fixture(scope="session")
def folder(
    side: Side, hand_results: list[HandResult], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Folder with their results.npz and results.csv."""
    path = tmp_path_factory.mktemp(f"results_{side}")
    record = RunRecord(camera=CAMERA, shape=unusual_shape(HandModel.load()), side=side)
    for place, result in enumerate(hand_results):
        record.add(make_frame(place), result)
    record.save(path, source="somewhere")
    return path


@pytest.fixture(scope="session")
def track(folder: Path) -> Track:
    """The same, read for export."""
    return read_track(folder)


@pytest.fixture(scope="session")
def frame_at() -> Callable[[int], DepthFrame]:
    """Makes the frame of a number."""
    return make_frame
