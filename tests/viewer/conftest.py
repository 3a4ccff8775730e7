"""What tests of the viewer share: the sample, a tracker that knows it, a pose, threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from handtrack.artifacts import artifact_path
from handtrack.camera.sequence import RecordedSequence
from handtrack.camera.source import open_sequence
from handtrack.hand.shape import HandShape
from handtrack.synthesis.renderer import DepthRenderer
from handtrack.tracking.tracker import HandTracker
from oracles.automatic import AutomaticOracle
from oracles.collector import Collector
from oracles.scenes import SMALL_CAMERA, seen_poses, shaped_hand


@pytest.fixture(scope="session")
def sample() -> Iterator[RecordedSequence]:
    """The sample sequence."""
    with open_sequence(artifact_path("data/demo.npz")) as sequence:
        assert isinstance(sequence, RecordedSequence)
        yield sequence


@pytest.fixture(scope="session")
def make_tracker(sample: RecordedSequence) -> Callable[[str], HandTracker]:
    """Makes trackers that know the sample by heart, whatever their name."""
    oracle = AutomaticOracle()
    oracle.learn(sample)
    assert sample.subject is not None
    shape = HandShape(
        alpha=np.asarray(sample.subject.alpha), beta=np.asarray(sample.subject.beta),
        scale=float(sample.subject.scale or 1.0),
    )  # fmt: skip

    def make(name: str) -> HandTracker:
        del name
        return HandTracker(sample.camera, config=oracle, shape=shape, device="cpu")

    return make


@pytest.fixture(scope="module")
def pose() -> np.ndarray:
    """A pose of the usual hand before the small camera."""
    return seen_poses(shaped_hand(), np.random.default_rng(8), 1, turn=0.3)[0]


@pytest.fixture(scope="module")
def depth(pose: np.ndarray) -> np.ndarray:
    """The depth image of that pose."""
    return DepthRenderer(shaped_hand(), SMALL_CAMERA, device="cpu", batch=1).render(pose[None])[0]


@pytest.fixture
def collector() -> Collector:
    return Collector()


@pytest.fixture
def in_thread() -> Iterator[Callable[[Callable[[], None]], threading.Thread]]:
    """Runs functions in threads, and sees that they end without an error."""
    threads: list[threading.Thread] = []
    errors: list[BaseException] = []

    def start(function: Callable[[], None]) -> threading.Thread:
        def run() -> None:
            try:
                function()
            except BaseException as error:
                errors.append(error)

        threads.append(threading.Thread(target=run, daemon=True))
        threads[-1].start()
        return threads[-1]

    yield start
    for thread in threads:
        thread.join(20.0)
        assert not thread.is_alive()
    assert not errors, errors
