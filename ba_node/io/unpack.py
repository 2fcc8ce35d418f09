# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Unpack compressed bytes up to a limit that is known before: a few kB may claim, or be, many GB."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Iterator
from io import BytesIO
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard

# Packed data may grow by this factor, as no measurement does, and anything up to this size.
MAX_GROWTH = 50
ALWAYS_ALLOWED_BYTES = 2**24
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

_PIECE = 2**20
# Of the memory for a zstd frame: that of the highest level of its command line.
_ZSTD_WINDOW = 2**27


class TooLargeError(ValueError):
    """Packed data that is larger, unpacked, than is allowed."""


def limit_for(packed_size: int, growth: int = MAX_GROWTH, always: int = ALWAYS_ALLOWED_BYTES) -> int:
    """Return how many bytes may come out of some packed ones."""
    return max(always, growth * packed_size)


def pieces(kind: str, stream: IO[bytes], limit: int) -> Iterator[bytes]:
    """Yield what a packed stream (bz2, gz, lz4, zstd) holds, piece by piece, up to ``limit`` bytes.

    Raises:
        TooLargeError: there are more; nothing beyond the limit has been unpacked.
        OSError, EOFError, RuntimeError, zstandard.ZstdError: it is damaged.
    """
    with _opened(kind, stream) as unpacked:
        total = 0
        while piece := unpacked.read(_PIECE):
            total += len(piece)
            if total > limit:
                raise TooLargeError(f"more than {limit >> 20} MB come out of it, which no recording needs")
            yield piece


def unpack(kind: str, data: bytes, limit: int) -> bytes:
    """Return what packed bytes hold; see :func:`pieces`."""
    if kind == "zstd" and 0 <= zstandard.frame_content_size(data) <= limit:
        return zstandard.decompress(data)
    return b"".join(pieces(kind, BytesIO(data), limit))


def _opened(kind: str, stream: IO[bytes]) -> Any:
    if kind == "bz2":
        return bz2.open(stream)
    if kind == "gz":
        return gzip.open(stream)
    if kind == "lz4":
        return lz4.frame.open(stream)
    assert kind == "zstd", kind
    unpacker = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW)
    return unpacker.stream_reader(stream, read_across_frames=True, closefd=False)
