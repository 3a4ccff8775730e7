"""PNG files that hold depth: reading them so that a damaged one is always noticed.

OpenCV's answer to a damaged PNG depends on its version (nothing, half an image, text on stderr),
so the file's structure and checksums are verified before it is decoded.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, MissingFileError
from handtrack.files import starts_with

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


@dataclass(frozen=True, slots=True, kw_only=True)
class PngHeader:
    """What a PNG says about its image."""

    width: int
    """Width [pixels]."""
    height: int
    """Height [pixels]."""
    bits: int
    """Bits per channel."""
    channels: int
    """Channels per pixel."""


def is_png(path: Path) -> bool:
    """Whether a file starts as a PNG does."""
    return starts_with(path, SIGNATURE)


def read_png_header(path: Path) -> PngHeader:
    """Size and type of a PNG, read from its first bytes.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It does not start as a PNG does.
    """
    return _header(_read_bytes(path, 64), path)


def read_png(path: Path, *, channels: int, bits: int) -> NDArray[Any]:
    """Pixels of a PNG.

    Args:
        path: The file.
        channels: Channels it must have, 1 or 3 (returned in the order blue, green, red).
        bits: Bits per channel it must have, 8 or 16.

    Returns:
        Pixels, shape (height, width) or (height, width, 3), uint8 or uint16.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It is truncated, corrupt, or of another type.
    """
    return decode_png(_read_bytes(path), path, channels=channels, bits=bits)


def decode_png(data: bytes, path: Path | str, *, channels: int, bits: int) -> NDArray[Any]:
    """Pixels of a PNG that is in memory.

    Args:
        data: The PNG.
        path: Where it comes from, for messages.
        channels: As in `read_png`.
        bits: As in `read_png`.

    Returns:
        As `read_png` does.

    Raises:
        DamagedFileError: It is truncated, corrupt, or of another type.
    """
    import cv2

    header = _header(data, path)
    if (header.channels, header.bits) != (channels, bits):
        raise DamagedFileError(
            f"{path} has {header.channels} channel(s) of {header.bits} bits: expected "
            f"{channels} of {bits} bits; a PNG converted for viewing has lost its depth"
        )
    _verify(data, path)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != (header.height, header.width):
        raise DamagedFileError(f"{path} cannot be decoded: record or copy it again")
    return pixels


def _read_bytes(path: Path, count: int = -1) -> bytes:
    """The file's first bytes, all of them by default."""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except FileNotFoundError:
        raise MissingFileError(f"{path} does not exist") from None
    except OSError as error:
        raise DamagedFileError(f"{path} cannot be read: {error.strerror or error}") from error


def _header(data: bytes, path: Path | str) -> PngHeader:
    """The header chunk, which always comes first."""
    if not data:
        raise DamagedFileError(f"{path} is empty: expected a PNG image")
    if data[:8] != SIGNATURE:
        raise DamagedFileError(f"{path} is not a PNG image: it starts with {data[:4]!r}")
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise DamagedFileError(f"{path} is truncated: it ends inside the PNG header")
    width, height, bits, colour = struct.unpack(">IIBB", data[16:26])
    return PngHeader(width=width, height=height, bits=bits, channels=_CHANNELS.get(colour, 0))


def _verify(data: bytes, path: Path | str) -> None:
    """Walk over the chunks up to IEND and check each checksum."""
    position = len(SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != checksum:
            raise DamagedFileError(f"{path} is corrupt: a checksum is wrong at byte {position}")
        if data[position + 4 : position + 8] == b"IEND":
            return
        position = end
    raise DamagedFileError(f"{path} is truncated: it ends after {len(data)} bytes, before its end")
