"""Checking the structure of a ROS 1 bag before a library of C++ reads it.

librealsense crashes or hangs on some damaged bags. The format (version 2.0,
https://wiki.ros.org/Bags/Format/2.0) is a row of records, each a header with named fields and data,
both with their length before them; chunks hold records again. Only lengths and names are read.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

from handtrack.errors import DamagedFileError

_START = len(b"#ROSBAG V2.0\n")
_CHUNK, _BAG_HEADER = b"\x05", b"\x03"
_OPERATIONS = {bytes([op]) for op in range(2, 8)}
_LENGTH = struct.Struct("<I")


def check_bag(path: Path) -> None:
    """Walk over all records of a bag.

    Raises:
        DamagedFileError: A record does not fit into the file or is none; or the bag was never
            finished.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for fields, begin, end in _records(data, _START, len(data)):
                if fields[b"op"] == _BAG_HEADER and fields.get(b"index_pos", b"") == bytes(8):
                    raise _BrokenRecordError(
                        "it was never finished: rosbag reindex repairs a bag whose recording "
                        "was cut off"
                    )
                if fields[b"op"] == _CHUNK and fields.get(b"compression") == b"none":
                    for _ in _records(data, begin, end):
                        pass
    except (_BrokenRecordError, OSError, ValueError) as error:  # ValueError: it is empty
        raise DamagedFileError(f"{path} is damaged: {error}") from None


class _BrokenRecordError(Exception):
    """Bytes that are no record."""


def _records(
    data: mmap.mmap, place: int, end: int
) -> Iterator[tuple[dict[bytes, bytes], int, int]]:
    """Fields of each record from a place on, with begin and end of its data."""
    while place < end:
        begin, stop = _span(data, place, end)
        fields = _fields(data[begin:stop], begin)
        begin, stop = _span(data, stop, end)
        yield fields, begin, stop
        place = stop


def _span(data: mmap.mmap, place: int, end: int) -> tuple[int, int]:
    """Begin and end of what follows a length."""
    begin = place + _LENGTH.size
    if begin > end:
        raise _BrokenRecordError(f"it ends in the middle of a record at byte {place}")
    stop = begin + _LENGTH.unpack_from(data, place)[0]
    if stop > end:
        raise _BrokenRecordError(f"what begins at byte {place} does not fit into it")
    return begin, stop


def _fields(header: bytes, place: int) -> dict[bytes, bytes]:
    """Fields of a record's header."""
    fields: dict[bytes, bytes] = {}
    at = 0
    while at + _LENGTH.size <= len(header):
        begin = at + _LENGTH.size
        at = begin + _LENGTH.unpack_from(header, at)[0]
        name, found, value = header[begin:at].partition(b"=")
        if at > len(header) or not found:
            break
        fields[name] = value
    if at != len(header) or fields.get(b"op") not in _OPERATIONS:
        raise _BrokenRecordError(f"there is no record at byte {place}")
    return fields
