"""Live sources: newest first, sensor time, a camera that is unplugged and put back."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.camera.live import LiveImage, LiveInfo, LiveOptions, LiveSequence
from handtrack.camera.readers.npz import write_npz_sequence
from handtrack.camera.source import LIVE_SOURCES, open_sequence
from handtrack.errors import DeviceError, InputError, MissingFileError

CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)
QUICK = LiveOptions(silence=0.3, first_retry=0.02, last_retry=0.05)


class ScriptedDriver:
    """A device that sends what a test puts in, when the test says so."""

    def __init__(self) -> None:
        self.camera, self.clock, self.number = CAMERA, 100.0, 0
        self.connected, self.unplugged = True, False
        self.opened = self.closed = 0
        self.box: list[LiveImage] = []
        self.there = threading.Condition()

    def open(self) -> LiveInfo:
        self.opened += 1
        if not self.connected:
            raise DeviceError("no scripted camera connected")
        self.unplugged = False
        return LiveInfo(name="scripted", camera=self.camera, frames_per_second=50.0)

    def read(self, timeout: float) -> LiveImage | None:
        with self.there:
            self.there.wait_for(lambda: self.box or self.unplugged, timeout)
            if self.unplugged:
                raise DeviceError("scripted camera was unplugged")
            return self.box.pop(0) if self.box else None

    def close(self) -> None:
        self.closed += 1

    def send(self, *, step: float = 0.02, skip: int = 0, value: int | None = None) -> None:
        self.number += 1 + skip
        self.clock += step
        pixels = np.full(self.camera.shape, self.number if value is None else value, np.uint16)
        with self.there:
            self.box.append(LiveImage(pixels, 0.001, self.clock, self.number))
            self.there.notify_all()

    def unplug(self) -> None:
        with self.there:
            self.connected, self.unplugged = False, True
            self.there.notify_all()


def wait(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.002)


def unplugged(
    driver: ScriptedDriver, live: LiveSequence
) -> tuple[Iterator[DepthFrame], DepthFrame, DepthFrame]:
    """Unplug after a first frame: the frames that follow, the first one, the news of the loss."""
    frames = iter(live)
    driver.send()
    first = next(frames)
    driver.unplug()
    return frames, first, next(frames)


@pytest.fixture
def driver():
    return ScriptedDriver()


@pytest.fixture
def live(driver):
    with LiveSequence(driver, format="scripted", options=QUICK) as sequence:
        yield sequence


def test_frames_are_metres_with_the_sensors_time_and_the_time_of_arrival(driver, live):
    assert live.live and live.status == "streaming" and live.dropped == 0
    assert (live.camera, live.frames_per_second, live.name) == (CAMERA, 50.0, "scripted")
    frames = iter(live)
    for place in range(3):
        before = time.perf_counter()
        driver.send(value=500 + place)
        frame = next(frames)
        np.testing.assert_allclose(frame.depth, (500 + place) * 1e-3, atol=1e-7)
        assert frame.index == place and frame.camera == CAMERA and frame.problem is None
        assert frame.time == pytest.approx(100.02 + 0.02 * place)
        assert frame.received is not None
        assert before <= frame.received <= time.perf_counter()
    assert live.dropped == 0


def test_a_slow_consumer_gets_the_newest_and_the_others_are_counted(driver, live):
    frames = iter(live)
    driver.send()
    next(frames)
    for _ in range(7):
        driver.send()
    wait(lambda: not driver.box and live._slot is not None and live._slot[0].number == 8)
    assert next(frames).depth[0, 0] == pytest.approx(0.008)
    assert live.dropped == 6
    driver.send(skip=3)  # lost on the cable
    assert next(frames).time == pytest.approx(driver.clock)
    assert live.dropped == 9


def test_what_comes_before_the_first_frame_is_asked_for_is_not_dropped(driver, live):
    for _ in range(5):
        driver.send()
    wait(lambda: live._slot is not None and live._slot[0].number == 5)
    assert next(iter(live)).depth[0, 0] == pytest.approx(0.005)
    assert live.dropped == 0


def test_an_unplugged_camera_is_told_and_taken_up_again_when_it_is_back(driver, live):
    frames, _, lost = unplugged(driver, live)
    assert lost.problem is not None and "unplugged" in lost.problem
    assert not lost.depth.any()
    assert live.status == "reconnecting"
    wait(lambda: driver.opened >= 4)  # it keeps trying
    driver.connected = True
    wait(lambda: live.status == "streaming")
    driver.send()
    back = next(frames)
    assert back.problem is None and back.depth.any()
    assert [lost.index, back.index] == [1, 2]
    assert back.time >= lost.time >= 100.02


def test_a_silent_camera_counts_as_gone(driver, live):
    frames = iter(live)
    driver.send()
    next(frames)
    problem = next(frames).problem
    assert problem is not None and "sent nothing for 0.3 s" in problem
    wait(lambda: driver.opened >= 2)
    assert driver.closed >= 1


def test_attempts_to_reconnect_become_rarer():
    driver = ScriptedDriver()
    options = LiveOptions(silence=0.1, first_retry=0.05, last_retry=10.0)
    with LiveSequence(driver, format="scripted", options=options):
        driver.unplug()
        time.sleep(1.0)
        # 0.05, 0.1, 0.2, 0.4 s apart: four attempts within a second, not twenty.
        assert 3 <= driver.opened - 1 <= 5


def test_a_clock_that_starts_anew_is_continued(driver, live):
    frames, before, _ = unplugged(driver, live)
    driver.clock, driver.number, driver.connected = 0.0, 0, True
    wait(lambda: live.status == "streaming")
    driver.send()
    first = next(frames).time
    assert before.time < first < before.time + 3.0
    driver.send()
    assert next(frames).time - first == pytest.approx(0.02)


def test_a_clock_that_went_on_is_kept(driver, live):
    frames, _, _ = unplugged(driver, live)
    driver.clock += 0.3
    driver.connected = True
    wait(lambda: live.status == "streaming")
    driver.send()
    assert next(frames).time == pytest.approx(driver.clock)


def test_another_camera_in_its_place_ends_the_frames(driver, live):
    frames, _, _ = unplugged(driver, live)
    driver.camera, driver.connected = CAMERA.resize(32, 24), True
    with pytest.raises(DeviceError, match="other intrinsics"):
        next(frames)
    assert live.status == "failed"


def test_a_mistake_of_a_driver_is_not_silent(driver, live, monkeypatch):
    def broken(timeout: float) -> LiveImage:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(driver, "read", broken)
    with pytest.raises(DeviceError, match="ZeroDivisionError: oops"):
        next(iter(live))


def test_an_image_of_another_size_is_flagged(driver, live):
    frames = iter(live)
    driver.camera = CAMERA.resize(32, 24)
    driver.send()
    problem = next(frames).problem
    assert problem is not None and "(24, 32)" in problem


def test_closing_ends_a_waiting_iteration_and_the_thread(driver, live):
    ended = threading.Event()

    def consume() -> None:
        assert list(live) == []
        ended.set()

    threading.Thread(target=consume, daemon=True).start()
    time.sleep(0.05)
    live.close()
    assert ended.wait(2.0)
    assert live.status == "closed" and driver.closed >= 1
    assert not live._thread.is_alive()
    live.close()


def test_a_missing_camera_and_a_wrong_size_are_told_at_once(driver):
    with pytest.raises(InputError, match=r"32x24.*16x12"):
        LiveSequence(driver, format="scripted", camera=CAMERA.resize(32, 24))
    assert driver.closed == 1
    driver.connected = False
    with pytest.raises(DeviceError, match="no scripted camera"):
        LiveSequence(driver, format="scripted")


@pytest.mark.parametrize("name", ["silence", "first_retry", "last_retry"])
def test_patience_must_be_positive(name):
    with pytest.raises(InputError, match=name):
        LiveOptions(**{name: 0.0})


@pytest.fixture
def recording(tmp_path):
    depth = np.linspace(0.3, 0.9, 5, dtype=np.float32)[:, None, None] * np.ones(CAMERA.shape)
    path = tmp_path / "s.npz"
    write_npz_sequence(path, depth, CAMERA, side="left", frames_per_second=100.0)
    return path


def test_a_recording_plays_as_if_it_was_a_camera_over_and_over(recording):
    with open_sequence(f"replay:{recording}") as sequence:
        assert sequence.live and sequence.frames_per_second == 100.0
        assert sequence.subject is not None and sequence.subject.side == "left"
        frames = list(itertools.islice(sequence, 12))
    depths = {round(float(frame.depth[0, 0]), 2) for frame in frames}
    assert depths <= {0.3, 0.45, 0.6, 0.75, 0.9} and len(depths) >= 3
    steps = np.diff([frame.time for frame in frames])
    np.testing.assert_allclose(steps, np.round(steps * 100) / 100, atol=1e-6)
    assert steps.min() > 0.005


def test_live_sources_are_told_apart_from_files(tmp_path, monkeypatch):
    assert set(LIVE_SOURCES) == {"realsense", "replay"}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "realsense").mkdir()
    cv2.imwrite("realsense/0.png", np.ones(CAMERA.shape, np.uint16))
    with open_sequence("./realsense", camera=CAMERA, depth_unit=0.001) as sequence:
        assert not sequence.live and sequence.status == "recorded" and sequence.dropped == 0
    with pytest.raises(MissingFileError, match="replay:realsense"):
        open_sequence("replay:replay:realsense")
    with pytest.raises(InputError, match="replay:PATH"):
        open_sequence("replay")
