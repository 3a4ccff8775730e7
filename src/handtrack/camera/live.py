"""Frames from a device as time passes: newest first, on through cables pulled and put back.

A thread reads the device into a mailbox with one slot. Whoever iterates takes the newest image and
never makes the device wait; images that nobody took are counted. The device itself is a
`LiveDriver`, a few calls that need know nothing of threads or of reconnecting.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtrack.camera.camera import Camera
from handtrack.camera.frame import DepthFrame, check_depth
from handtrack.camera.sequence import Sequence, Subject, check_override
from handtrack.errors import DeviceError, InputError

STREAMING, RECONNECTING, FAILED, CLOSED = "streaming", "reconnecting", "failed", "closed"
LIVE_STATUSES = (STREAMING, RECONNECTING, FAILED, CLOSED)
"""What `LiveSequence.status` says: frames come; the device is away and tried again; it came back as
something else, which ends the frames; closed."""

_POLL = 0.1
"""How often a waiting thread looks whether it should end [s]."""
_CLOCK_GAP = 1.0
"""A device clock that is so far from where it should be after reconnecting has started anew [s]."""


@dataclass(frozen=True, slots=True)
class LiveImage:
    """One image as a driver hands it over."""

    pixels: NDArray[Any]
    """Depth in units of `unit`, shape (height, width), the receiver's own; 0 = no measurement."""
    unit: float
    """What one step of the pixels is [m]; 1 for metres."""
    time: float
    """Time of exposure by the device's clock [s]."""
    number: int
    """Number of the frame by the device's count; gaps are frames that were lost on the way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveInfo:
    """What a driver knows about a device that it has opened."""

    name: str
    """Name of the device."""
    camera: Camera
    """Intrinsics of its depth images."""
    frames_per_second: float | None = None
    """Its frame rate [1/s]."""
    subject: Subject | None = None
    """Whose hand is in view, where the driver knows."""


class LiveDriver(Protocol):
    """A kind of depth camera. All calls come from one thread at a time."""

    def open(self) -> LiveInfo:
        """Find and start the device.

        Raises:
            DeviceError: It is not there or does not start; the message says what is.
            MissingDependencyError: The package for it is not installed.
        """
        ...

    def read(self, timeout: float) -> LiveImage | None:
        """Next image, None if there was none within `timeout` [s].

        Raises:
            DeviceError: The device is gone.
        """
        ...

    def close(self) -> None:
        """Stop the device; also after a failed `open`, and more than once."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """How patient a live source is."""

    silence: float = 2.0
    """A device that sends nothing for so long is taken for gone [s]."""
    first_retry: float = 0.25
    """Wait before the first attempt to reconnect [s]; it doubles with every attempt."""
    last_retry: float = 4.0
    """Longest wait between attempts [s]."""

    def __post_init__(self) -> None:
        for name in ("silence", "first_retry", "last_retry"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)!r}: expected seconds above 0")


class LiveSequence(Sequence):
    """Frames of a device, the newest one whenever the next is asked for.

    A device that goes away is tried again until it is back or the sequence is closed. The loss
    itself is one frame without depth whose `problem` says what happened, so that a tracker
    notices; then iterating waits. Frame times are those of the device's clock; if it starts anew
    after reconnecting, it is continued from where it was.

    Args:
        driver: The device; opened here, so that a missing one is noticed at once.
        format: Name of the source, as given to `open_sequence`.
        camera: Intrinsics to use instead of the device's own.
        options: Patience.

    Raises:
        DeviceError: The device is not there.
        InputError: `camera` is of another image size.
    """

    def __init__(
        self,
        driver: LiveDriver,
        *,
        format: str,
        camera: Camera | None = None,
        options: LiveOptions = LiveOptions(),
    ) -> None:
        self._driver, self._options, self.format = driver, options, format
        try:
            info = driver.open()
            self.camera, self._own = check_override(camera, info.camera, info.name), info.camera
        except BaseException:
            driver.close()
            raise
        self.name, self.frames_per_second = info.name, info.frames_per_second
        self.subject = info.subject
        self._mail = threading.Condition()
        self._slot: tuple[LiveImage, float] | None = None  # with its time of arrival
        self._loss: str | None = None  # a loss that was not told yet
        self._failure: str | None = None
        self._status = STREAMING
        self._dropped = 0
        self._asked = False
        self._index = 0
        self._clock = _ContinuedClock()
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._capture, name=f"handtrack-{format}", daemon=True
        )
        self._thread.start()

    @property
    def live(self) -> bool:
        """Frames come as time passes."""
        return True

    @property
    def dropped(self) -> int:
        """Frames never handed out since the first was asked for.

        Newer ones were there, or the device or its cable lost them.
        """
        return self._dropped

    @property
    def status(self) -> str:
        """One of `LIVE_STATUSES`."""
        return self._status

    def __iter__(self) -> Iterator[DepthFrame]:
        """Wait for frames and yield the newest, until the sequence is closed.

        Raises:
            DeviceError: The device came back as another one.
        """
        while True:
            loss = taken = None
            with self._mail:
                self._asked = True
                # In slices, so that Ctrl-C is noticed on every system.
                while not (self._loss or self._slot or self._status in (FAILED, CLOSED)):
                    self._mail.wait(_POLL)
                if self._status == CLOSED:
                    return
                if self._loss is not None:
                    loss, self._loss = self._loss, None
                else:
                    taken, self._slot = self._slot, None
            if loss is not None:
                yield self._nothing(loss)
            elif taken is not None:
                yield self._frame(*taken)
            else:
                raise DeviceError(self._failure or f"{self.name} failed")

    def close(self) -> None:
        """Stop the device and end the iteration; may be called from any thread."""
        self._stop.set()
        with self._mail:
            self._status, self._slot = CLOSED, None
            self._mail.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _frame(self, image: LiveImage, received: float) -> DepthFrame:
        """The image as a frame in metres."""
        metres = np.multiply(image.pixels, np.float32(image.unit), dtype=np.float32)
        depth, problem = check_depth(metres, self.camera)
        return self._numbered(depth, image.time, received, problem)

    def _nothing(self, problem: str) -> DepthFrame:
        """A frame without depth, stamped with the time that has passed since the last one."""
        received = time.perf_counter()
        return self._numbered(
            np.zeros(self.camera.shape, np.float32), self._clock.at(received), received, problem
        )

    def _numbered(
        self, depth: NDArray[np.float32], stamp: float, received: float, problem: str | None
    ) -> DepthFrame:
        """The next frame."""
        index, self._index = self._index, self._index + 1
        return DepthFrame(
            depth=depth, camera=self.camera, time=stamp, index=index,
            name=f"{self.format}[{index}]", received=received, problem=problem,
        )  # fmt: skip

    def _capture(self) -> None:
        """Thread: read the device into the mailbox until told to stop."""
        try:
            while not self._stop.is_set():
                reason = self._read_until_lost()
                if reason is not None and not self._reconnect(reason):
                    return
        except Exception as error:  # a driver's mistake must not end in silence
            self._fail(f"{self.name}: {type(error).__name__}: {error}")
        finally:
            with contextlib.suppress(Exception):
                self._driver.close()

    def _read_until_lost(self) -> str | None:
        """Read until the device is gone, and say so; None when told to stop."""
        number: int | None = None
        last = time.perf_counter()
        while not self._stop.is_set():
            try:
                image = self._driver.read(_POLL)
            except DeviceError as error:
                return str(error)
            now = time.perf_counter()
            if image is None:
                if now - last > self._options.silence:
                    return f"{self.name} sent nothing for {self._options.silence:g} s"
                continue
            last = now
            image = self._clock.continued(image, now)
            with self._mail:
                if self._stop.is_set():
                    return None
                if self._asked:
                    self._dropped += self._slot is not None
                    if number is not None:
                        self._dropped += max(0, image.number - number - 1)
                number = image.number
                self._slot = image, now
                self._mail.notify_all()
        return None

    def _reconnect(self, reason: str) -> bool:
        """Try to open the device again and again; False when that is over."""
        with self._mail:
            self._status, self._loss = RECONNECTING, f"{reason}; waiting for it to come back"
            # An image that nobody took is not shown after the news of the loss.
            self._dropped += self._asked and self._slot is not None
            self._slot = None
            self._mail.notify_all()
        self._clock.lose()
        wait = self._options.first_retry
        while True:
            with contextlib.suppress(Exception):
                self._driver.close()
            if self._stop.wait(wait):
                return False
            wait = min(2 * wait, self._options.last_retry)
            try:
                info = self._driver.open()
            except DeviceError:
                continue
            if info.camera != self._own:
                self._fail(
                    f"{self.name} came back with other intrinsics ({info.camera} instead of "
                    f"{self._own}): open it anew"
                )
                return False
            with self._mail:
                if self._status == RECONNECTING:
                    self._status = STREAMING
            return True

    def _fail(self, reason: str) -> None:
        """End the iteration with an error."""
        with self._mail:
            if self._status != CLOSED:
                self._status, self._failure = FAILED, reason
            self._mail.notify_all()


class _ContinuedClock:
    """The device's clock, continued when it starts anew after the device was away."""

    def __init__(self) -> None:
        self._offset = 0.0
        self._last: tuple[float, float] | None = None  # told time, host time
        self._lost = False

    def lose(self) -> None:
        """The device is away; its next time stamp may be of another clock."""
        self._lost = True

    def at(self, host: float) -> float:
        """What the clock should show at a host time [s]."""
        return host if self._last is None else self._last[0] + host - self._last[1]

    def continued(self, image: LiveImage, host: float) -> LiveImage:
        """The image with a time stamp [s] that fits those before."""
        if self._lost:
            expected = self.at(host)
            if abs(image.time + self._offset - expected) > _CLOCK_GAP:
                self._offset = expected - image.time
            self._lost = False
        told = image.time + self._offset
        if self._last is not None:
            told = max(told, self._last[0])
        self._last = told, host
        return LiveImage(image.pixels, image.unit, told, image.number)
