"""Recording frames to a folder of PNG images while they come, safe against being killed.

The folder is one of our own recordings (docs/formats.md, png) at every moment: its camera.json is
there before the first image, a time stamp before its image, and an image appears whole or not at
all. Images are compressed and written by a thread, so that a tracking loop need not wait for it.
"""

from __future__ import annotations

import json
import os
import queue
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame
from handtrack.camera.sequence import check_unit
from handtrack.errors import InputError
from handtrack.files import whole_file

COMPRESSION = 1
"""Level of PNG compression; higher ones cost several times the time for a few percent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderOptions:
    """How a recording is written."""

    depth_unit: float = 0.0001
    """What one step of the images is [m]; 65535 steps reach 6.5 m, depth beyond is left out."""
    waiting: int = 60
    """So many frames may wait for the disk; when there are more, new ones are left out."""

    def __post_init__(self) -> None:
        check_unit(self.depth_unit, "the recorder's options")
        if self.waiting < 1:
            raise InputError(f"waiting is {self.waiting}: expected 1 frame or more")


class Recorder:
    """Writes frames to a new folder; use it in a ``with`` block or call `close`.

    Args:
        folder: Where to; made with its parents, and must not hold images yet.
        camera: Camera of the frames.
        frames_per_second: Frame rate to be told [1/s].
        side: "right" or "left" where it is known whose hand it is.
        lossless: Let `frame` wait for a slow disk instead of leaving frames out.
        options: How it is written.

    Raises:
        InputError: The folder holds images already or cannot be written.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        camera: Camera,
        *,
        frames_per_second: float | None = None,
        side: str | None = None,
        lossless: bool = False,
        options: RecorderOptions = RecorderOptions(),
    ) -> None:
        self.folder = Path(folder)
        self.written = 0
        """Frames on the disk."""
        self.dropped = 0
        """Frames that were left out because the disk was too slow."""
        self._camera, self._lossless, self._unit = camera, lossless, options.depth_unit
        facts: dict[str, Any] = {**camera.to_dict(), "depth_unit_m": options.depth_unit}
        if frames_per_second is not None:
            facts["frames_per_second"] = frames_per_second
        if side is not None:
            facts["hand"] = side
        self._error: OSError | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if next(self.folder.glob("*.[pP][nN][gG]"), None) is not None:
                raise InputError(f"{self.folder} holds images already: record to another folder")
            with whole_file(self.folder / "camera.json") as file:
                file.write((json.dumps(facts, indent=2) + "\n").encode())
            self._times = (self.folder / "times.csv").open("w", encoding="utf-8", newline="")
            self._put_line("file,time_s")
        except OSError as error:
            raise self._unwritable(error) from error
        self._last_time = -np.inf
        self._waiting: queue.Queue[DepthFrame | None] = queue.Queue(options.waiting)
        self._thread = threading.Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def frame(self, frame: DepthFrame, result: object = None) -> None:
        """Take a frame to be written; one that could not be read is left out.

        Args:
            frame: The frame; its depth must not be changed afterwards.
            result: Not needed; whatever takes tracked frames is called with it.

        Raises:
            InputError: The frame is of another size, or the folder cannot be written any more.
        """
        del result
        if self._error is not None:
            raise self._unwritable(self._error)
        if frame.depth.shape != self._camera.shape:
            raise InputError(
                f"a frame of shape {frame.depth.shape} does not fit the recording's "
                f"{self._camera.shape} (height, width)"
            )
        if frame.problem is not None:
            return
        try:
            self._waiting.put(frame, block=self._lossless)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits.

        Raises:
            InputError: The folder could not be written to the end.
        """
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
            self._times.close()
            if self._error is not None:
                raise self._unwritable(self._error)

    def _write_all(self) -> None:
        """Thread: write frames until told to stop; after an error only take them away."""
        while (frame := self._waiting.get()) is not None:
            if self._error is None:
                try:
                    self._write(frame)
                except OSError as error:
                    self._error = error

    def _write(self, frame: DepthFrame) -> None:
        """One image and its time stamp, the stamp first: one too many does no harm."""
        import cv2

        steps = np.rint(frame.depth * np.float32(1.0 / self._unit))
        steps[steps > np.iinfo(np.uint16).max] = 0.0
        encoded, data = cv2.imencode(
            ".png", steps.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION]
        )
        assert encoded, "OpenCV always has PNG"
        name = f"{self.written:06d}.png"
        self._last_time = max(self._last_time, frame.time)
        self._put_line(f"{name},{self._last_time:.6f}")
        with whole_file(self.folder / name) as file:
            file.write(data.tobytes())
        self.written += 1

    def _put_line(self, line: str) -> None:
        """A line of the table of times, with the system before the next step."""
        self._times.write(f"{line}\n")
        self._times.flush()

    def _unwritable(self, error: OSError) -> InputError:
        return InputError(
            f"cannot record to {self.folder}: {error.strerror or error}; "
            f"{self.written} frames are there"
        )
