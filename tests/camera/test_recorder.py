"""Recordings that are readable at every moment, also after the process was killed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.camera.recorder import Recorder, RecorderOptions
from handtrack.camera.source import open_sequence
from handtrack.errors import InputError

CAMERA = Camera(width=32, height=24, fx=40.0, fy=41.0, cx=16.5, cy=12.0)


def frame(index: int, **changes: object) -> DepthFrame:
    depth = np.random.default_rng(index).uniform(0.2, 1.2, CAMERA.shape).astype(np.float32)
    depth[0] = 0.0
    facts = {"depth": depth, "camera": CAMERA, "time": 50.0 + index / 60, "index": index}
    return DepthFrame(**(facts | changes))  # type: ignore[arg-type]


def test_what_was_recorded_is_read_back(tmp_path):
    folder = tmp_path / "new" / "recording"
    with Recorder(folder, CAMERA, frames_per_second=60.0, side="left", lossless=True) as recorder:
        for index in range(8):
            recorder.frame(frame(index), None)
    assert recorder.written == 8 and recorder.dropped == 0
    with open_sequence(folder) as sequence:
        assert sequence.format == "png" and sequence.camera == CAMERA
        assert sequence.frames_per_second == 60.0
        assert sequence.subject is not None and sequence.subject.side == "left"
        for index, read in enumerate(sequence):
            np.testing.assert_allclose(read.depth, frame(index).depth, atol=0.51e-4)
            assert read.time == pytest.approx(50.0 + index / 60, abs=1e-6)
            assert (read.depth[0] == 0).all()
    recorder.close()


def test_depth_out_of_reach_is_left_out_and_not_wrapped(tmp_path):
    depth = np.full(CAMERA.shape, 6.6, np.float32)
    depth[0, 0] = 6.5
    with Recorder(tmp_path, CAMERA) as recorder:
        recorder.frame(frame(0, depth=depth))
    with open_sequence(tmp_path) as sequence:
        read = sequence[0].depth
    assert read[0, 0] == pytest.approx(6.5, abs=1e-4) and not read[1:].any()


def test_whole_millimetres_stay_exact(tmp_path):
    steps = np.arange(CAMERA.height * CAMERA.width).reshape(CAMERA.shape) % 6000
    with Recorder(tmp_path, CAMERA) as recorder:
        recorder.frame(frame(0, depth=(steps * 1e-3).astype(np.float32)))
    with open_sequence(tmp_path) as sequence:
        np.testing.assert_allclose(sequence[0].depth, steps * 1e-3, atol=1e-6)


def test_frames_that_could_not_be_read_are_left_out_and_time_never_runs_back(tmp_path):
    with Recorder(tmp_path, CAMERA, lossless=True) as recorder:
        recorder.frame(frame(0))
        recorder.frame(frame(1, problem="unplugged"))
        recorder.frame(frame(2, time=49.0))
    with open_sequence(tmp_path) as sequence:
        assert [read.time for read in sequence] == [50.0, 50.0]


def test_a_slow_disk_costs_frames_and_no_time(tmp_path, monkeypatch):
    original = Recorder._write

    def slow(self: Recorder, one: DepthFrame) -> None:
        time.sleep(0.1)
        original(self, one)

    monkeypatch.setattr(Recorder, "_write", slow)
    with Recorder(tmp_path, CAMERA, options=RecorderOptions(waiting=2)) as recorder:
        begin = time.perf_counter()
        for index in range(10):
            recorder.frame(frame(index))
        assert time.perf_counter() - begin < 0.1
    assert 2 <= recorder.written <= 4 and recorder.dropped == 10 - recorder.written


def test_a_folder_with_images_is_not_touched(tmp_path):
    with Recorder(tmp_path, CAMERA) as recorder:
        recorder.frame(frame(0))
    with pytest.raises(InputError, match="holds images already"):
        Recorder(tmp_path, CAMERA)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot record to"):
        Recorder(tmp_path / "file", CAMERA)


def test_a_disk_that_fails_is_told(tmp_path, monkeypatch):
    def full(self: Recorder, one: DepthFrame) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recorder, "_write", full)
    recorder = Recorder(tmp_path, CAMERA)
    recorder.frame(frame(0))
    with pytest.raises(InputError, match="No space left on device"):
        recorder.close()


def test_a_frame_of_another_size_is_refused(tmp_path):
    with Recorder(tmp_path, CAMERA) as recorder, pytest.raises(InputError, match=r"\(3, 3\)"):
        recorder.frame(frame(0, depth=np.zeros((3, 3), np.float32)))


KILLED = """
import sys, itertools, numpy as np
from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.camera.recorder import Recorder

camera = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
recorder = Recorder(sys.argv[1], camera, lossless=True)
for index in itertools.count():
    depth = np.full(camera.shape, 0.3 + index * 1e-4, np.float32)
    recorder.frame(DepthFrame(depth=depth, camera=camera, time=index / 60, index=index))
    print(recorder.written, flush=True)
"""


def test_a_killed_process_leaves_a_readable_recording(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    written = 0
    while written < 25:
        written = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    with open_sequence(tmp_path) as sequence:
        frames = list(sequence)
    assert len(frames) >= written
    for index, read in enumerate(frames):
        assert read.problem is None
        np.testing.assert_allclose(read.depth, 0.3 + index * 1e-4, atol=0.51e-4)
        assert read.time == pytest.approx(index / 60, abs=1e-6)


@pytest.mark.parametrize("end", ["0000", "000003.png", "000003.png,", "000003.png,1", "fi"])
def test_a_table_of_times_that_was_cut_off_in_a_line_is_read(tmp_path, end):
    with Recorder(tmp_path, CAMERA, lossless=True) as recorder:
        for index in range(3):
            recorder.frame(frame(index))
    with (tmp_path / "times.csv").open("a") as file:
        file.write(end)
    with open_sequence(tmp_path) as sequence:
        assert [read.time for read in sequence] == pytest.approx([50 + i / 60 for i in range(3)])
