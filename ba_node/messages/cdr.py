# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write a message as little-endian CDR, field by field: what DDS sends and MCAP files hold.

Numbers are aligned to their size, counted from behind the 4 bytes that name the encoding. An array of rows is appended
as it lies in memory: no object is made for a row.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from ba_node.messages.factory import stamp_parts

if TYPE_CHECKING:
    from numpy.typing import NDArray

_ENCODING = b"\x00\x01\x00\x00"


class Cdr:
    """A message that grows."""

    def __init__(self) -> None:
        """Start empty."""
        self._parts: list[bytes] = []
        self._size = 0

    def pack(self, layout: str, *values: float) -> None:
        """Append numbers, given by the letters of ``struct``, each aligned to its size; ``3d`` is three of them."""
        kinds = _kinds(layout)
        for kind, value in zip(kinds, values, strict=True):
            size = struct.calcsize(f"<{kind}")
            self._append(bytes(-self._size % size) + struct.pack(f"<{kind}", value))

    def text(self, text: str) -> None:
        """Append a string."""
        data = text.encode() + b"\x00"
        self.pack("I", len(data))
        self._append(data)

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a ``std_msgs/Header``; raise ConversionError if the stamp exceeds it."""
        self.pack("iI", *stamp_parts(stamp_ns))
        self.text(frame_id)

    def sequence(self, rows: NDArray[Any]) -> None:
        """Append a sequence of rows of little-endian numbers of one kind, (n, k)."""
        self.pack("I", len(rows))
        if len(rows):
            self._append(bytes(-self._size % rows.dtype.itemsize))
            self._append(rows.tobytes())

    def data(self) -> bytes:
        """Return the message."""
        return b"".join([_ENCODING, *self._parts])

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)


def _kinds(layout: str) -> str:
    """Write repeated letters out: ``3d`` -> ``ddd``."""
    out, count = "", ""
    for letter in layout:
        if letter.isdigit():
            count += letter
        else:
            out += letter * int(count or 1)
            count = ""
    return out
