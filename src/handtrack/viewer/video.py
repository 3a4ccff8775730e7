"""Videos and animated pictures, through the codecs that come with OpenCV."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from handtrack.errors import HandtrackError, InputError
from handtrack.viewer.depth_colours import Image

CODECS: dict[str, str] = {".mp4": "mp4v", ".webm": "VP90", ".avi": "MJPG", ".mkv": "mp4v"}
"""File ending -> codec; these need nothing beside OpenCV's own wheel."""

ANIMATIONS: tuple[str, ...] = (".gif", ".webp")
"""Endings of animated pictures, kept in memory until they are closed."""

FALLBACK = ".avi"
"""Ending used where an installation of OpenCV lacks the codec asked for; every one has MJPG."""


class VideoError(HandtrackError, RuntimeError):
    """A video cannot be written by this installation of OpenCV."""


class VideoWriter:
    """Writes pictures of one size into a video; use it in a ``with`` block.

    The file appears under its name when the block ends without an error, complete or not at all.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        frames_per_second: float = 30.0,
        quality: int | None = None,
    ) -> None:
        """Choose the format by the ending of the file.

        Args:
            path: File to write; its folder must exist.
            frames_per_second: Frame rate [1/s].
            quality: 1 to 100 for a .webp, small to good; OpenCV's own choice when None.

        Raises:
            InputError: The ending is not known, rate or quality are out of range, or there is no
                folder.
        """
        self.path = Path(path)
        """File that will be there at the end; ends in .avi where OpenCV lacks the codec."""
        self.count = 0
        """Number of pictures written."""
        if self.path.suffix.lower() not in (*CODECS, *ANIMATIONS):
            raise InputError(
                f"video {str(path)!r} ends in {self.path.suffix!r}: expected one of "
                f"{', '.join((*CODECS, *ANIMATIONS))}"
            )
        if not 0.1 <= frames_per_second <= 1000:
            raise InputError(f"frames_per_second is {frames_per_second}: expected 0.1 to 1000")
        if quality is not None and (self.path.suffix.lower() != ".webp" or not 1 <= quality <= 100):
            raise InputError(
                f"quality is {quality} for a {self.path.suffix} file: expected 1 to 100 for .webp, "
                "None for others"
            )
        if not self.path.resolve().parent.is_dir():
            raise InputError(f"{self.path.resolve().parent} is no folder: create it first")
        self._rate = float(frames_per_second)
        self._options = [cv2.IMWRITE_WEBP_QUALITY, quality] if quality is not None else []
        self._size: tuple[int, int] | None = None
        self._writer: cv2.VideoWriter | None = None
        self._unfinished: Path | None = None
        self._pictures: list[Image] | None = [] if self.path.suffix.lower() in ANIMATIONS else None

    def write(self, picture: Image) -> None:
        """Append a picture, shape (height, width, 3), uint8, channels B G R, all of one size.

        Raises:
            InputError: The picture has another type or size than the first one.
            VideoError: OpenCV has no codec for it.
        """
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise InputError(
                f"picture is {picture.dtype} with shape {picture.shape}: expected uint8 with shape "
                "(height, width, 3)"
            )
        size = (picture.shape[1], picture.shape[0])
        if self._size is None:
            if min(size) < 2 or (self._pictures is None and (size[0] % 2 or size[1] % 2)):
                raise InputError(f"picture is {size[0]}x{size[1]}: a video needs even sides")
            self._size = size
            if self._pictures is None:
                self._open(size)
        elif size != self._size:
            raise InputError(
                f"picture is {size[0]}x{size[1]}: the first one was {self._size[0]}x{self._size[1]}"
            )
        if self._pictures is not None:
            self._pictures.append(picture.copy())
        else:
            assert self._writer is not None
            self._writer.write(np.ascontiguousarray(picture))
        self.count += 1

    def _open(self, size: tuple[int, int]) -> None:
        """Open the codec of the ending, else the one that every OpenCV has."""
        for suffix in dict.fromkeys((self.path.suffix.lower(), FALLBACK)):
            target = self.path.with_suffix(suffix)
            part = target.with_name(f".{target.stem}.{os.getpid()}.part{suffix}")
            code = cv2.VideoWriter.fourcc(*CODECS[suffix])
            writer = cv2.VideoWriter(str(part), code, self._rate, size)
            if writer.isOpened():
                self.path, self._writer, self._unfinished = target, writer, part
                return
            writer.release()
            part.unlink(missing_ok=True)
        raise VideoError(
            f"this OpenCV ({cv2.__version__}) can write neither {self.path.suffix} nor {FALLBACK}: "
            "reinstall opencv-python-headless, or go on without a video"
        )

    def close(self) -> None:
        """Finish the file and give it its name; without any picture there is no file."""
        if self._pictures:
            self._write_animation(self._pictures)
        self._pictures = None if self._pictures is None else []
        if self._writer is not None:
            assert self._unfinished is not None
            self._writer.release()
            self._writer = None
            self._unfinished.replace(self.path)

    def discard(self) -> None:
        """Give up: no file is left behind."""
        self._pictures = None if self._pictures is None else []
        if self._writer is not None:
            assert self._unfinished is not None
            self._writer.release()
            self._writer = None
            self._unfinished.unlink(missing_ok=True)

    def _write_animation(self, pictures: list[Image]) -> None:
        """Write a GIF or WebP by OpenCV 4.11 or newer."""
        make: Any = getattr(cv2, "Animation", None)
        part = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part{self.path.suffix}")
        written = False
        if make is not None:
            animation = make()
            animation.frames = pictures
            animation.durations = np.full(len(pictures), round(1e3 / self._rate), np.int32)
            try:
                written = bool(cv2.imwriteanimation(str(part), animation, self._options))
            except cv2.error:
                written = False
        if not written:
            part.unlink(missing_ok=True)
            raise VideoError(
                f"this OpenCV ({cv2.__version__}) cannot write animated {self.path.suffix} files: "
                "install opencv-python-headless 4.11 or newer, or choose .mp4"
            )
        part.replace(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()
