"""The container of binary glTF 2.0: a JSON chunk and one buffer of typed arrays."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtrack.export.frame_document import to_json

_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES: dict[tuple[int, ...], str] = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}

VERTICES, TRIANGLES = 34962, 34963
"""Targets of buffer views: vertex attributes and indices."""


class Buffer:
    """Collects arrays, and the accessors and buffer views that describe them."""

    def __init__(self) -> None:
        """Start empty."""
        self._bytes = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, target: int | None = None) -> int:
        """Append an array and return the index of its accessor.

        Args:
            array: Elements along the first axis, of type uint8, uint16, uint32 or float32; matrices
                as usual, row by row.
            target: `VERTICES` or `TRIANGLES`; None for what is not drawn.
        """
        kind = array.dtype.str[1:]
        element = array.shape[1:]
        if len(element) == 2:
            array = np.swapaxes(array, 1, 2)  # glTF keeps matrices column by column
        flat = array.reshape(len(array), -1)
        view = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": array.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self._bytes += np.ascontiguousarray(array).tobytes()
        self._bytes += b"\0" * (-len(self._bytes) % 4)
        self.accessors.append({
            "bufferView": len(self.views) - 1, "componentType": _COMPONENTS[kind],
            "count": len(array), "type": _TYPES[element],
            "min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist(),
        })  # fmt: skip
        return len(self.accessors) - 1

    def glb(self, document: dict[str, Any]) -> bytes:
        """The file: the document with the arrays' description added, then the arrays."""
        document = {
            **document,
            "buffers": [{"byteLength": len(self._bytes)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        text = to_json(document).encode("utf-8")
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._bytes), b"BIN\0") + bytes(self._bytes)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
