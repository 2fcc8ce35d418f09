# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read a BAL file on several ranks, each its share, so that none ever holds the whole.

The text is cut into as many pieces as there are ranks, at the words where they begin. Each rank turns its piece into
numbers; then rows go where they belong. Observations go to the rank that has their point, which is known only once all
have been counted by point: so these are sent twice, and read once. Compressed files are unpacked by each rank to their
end, but only its piece is kept.

What is wrong with a file is told as :func:`ba_node.io.bal.read_bal` tells it, which then reads the whole.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.communicator import Communicator
from ba_node.core.ranks import point_cuts
from ba_node.io.bal import MAX_BYTES, MAX_GROWTH, BalError, BalProblem, numbers_of, read_bal
from ba_node.io.files import opened
from ba_node.io.unpack import limit_for, pieces
from ba_node.offline.ranks import together

# Numbers of a row.
_OBSERVATION, _CAMERA, _POINT = 4, 9, 3
_PACKED = (".bz2", ".gz")
# No number has more characters.
_LONGEST = 1024


@dataclass(frozen=True)
class BalShare:
    """The part of a problem that one rank has."""

    bal: BalProblem  # all cameras; this rank's points, numbered from 0, and their observations in the file's order
    first: int  # number in the file of this rank's first point
    n_points: int  # of all


def read_share(path: Path, communicator: Communicator) -> BalShare:
    """Read this rank's part of a problem; every rank has to call it.

    Raises:
        BalError: the file is not one that ``read_bal`` reads.
        ProblemError: it holds fewer points than there are ranks.
        RanksError: one of these, on another rank.
    """
    # The last number of all may be what is missing, so what is found is judged by all together.
    values = together(communicator, lambda: _piece(path, communicator.rank, communicator.size))
    told = communicator.broadcast(communicator.gather((len(values), values[:3])))
    starts = np.cumsum([0] + [count for count, _ in told])
    head = np.concatenate([few for _, few in told])[:3]
    n_cameras, n_points, n_obs = together(communicator, lambda: _counts(path, head, int(starts[-1])))
    ends = 3 + np.cumsum([_OBSERVATION * n_obs, _CAMERA * n_cameras])
    tokens = _Tokens(values, int(starts[communicator.rank]), communicator)
    even = n_obs * np.arange(communicator.size + 1) // communicator.size
    rows = tokens.rows(3, _OBSERVATION, even)
    together(communicator, lambda: _require_indices(path, rows, np.array([n_cameras, n_points])))
    point = rows[:, 1].astype(np.intp)
    seen = communicator.sum(np.bincount(point, minlength=n_points).astype(float))
    cuts = together(communicator, lambda: point_cuts(np.cumsum(seen).astype(np.intp), communicator.size))
    cameras = tokens.rows(int(ends[0]), _CAMERA, np.append(0, np.full(communicator.size, n_cameras)))
    cameras = communicator.broadcast(cameras if communicator.rank == 0 else None)
    points = tokens.rows(int(ends[1]), _POINT, cuts).copy()
    del values, tokens
    owner = np.searchsorted(cuts, point, side="right") - 1
    rows = np.concatenate(communicator.exchange([rows[owner == rank] for rank in range(communicator.size)]))
    first = int(cuts[communicator.rank])
    index = rows[:, :2].astype(np.intp)
    bal = BalProblem(cameras, points, index[:, 0], index[:, 1] - first, rows[:, 2:].copy())
    return BalShare(bal, first, n_points)


def share_of(bal: BalProblem, rank: int, size: int) -> BalShare:
    """Return the part that a rank has of a problem that it holds.

    Raises:
        ProblemError: there are fewer points than ranks.
    """
    cuts = point_cuts(np.cumsum(np.bincount(bal.point_index, minlength=len(bal.points))), size)
    first, stop = cuts[rank : rank + 2].tolist()
    own = np.flatnonzero((bal.point_index >= first) & (bal.point_index < stop))
    index = bal.camera_index[own], bal.point_index[own] - first
    part = BalProblem(bal.cameras, bal.points[first:stop].copy(), *index, bal.observations[own])
    return BalShare(part, first, len(bal.points))


def whole(share: BalShare, communicator: Communicator) -> BalProblem | None:
    """Return the problem of which all ranks have a part on rank 0, None on others; its observations go by points."""
    bal = share.bal
    told = communicator.gather((bal.points, bal.camera_index, bal.point_index + share.first, bal.observations))
    return None if told is None else BalProblem(bal.cameras, *map(np.concatenate, zip(*told, strict=True)))


@dataclass(frozen=True)
class _Tokens:
    """The numbers of a file, dealt to ranks as they stand there."""

    own: FloatArray
    first: int  # number in the file of the first of them
    communicator: Communicator

    def rows(self, begin: int, width: int, bounds: IntArray) -> FloatArray:
        """Return what this rank has of a table, (n, width), that begins at a number; rank r has bounds[r : r + 2]."""
        ends = np.clip(begin + width * bounds - self.first, 0, len(self.own))
        parts = [self.own[a:b] for a, b in itertools.pairwise(ends)]
        found = [part for part in self.communicator.exchange(parts) if len(part)]
        return (found[0] if len(found) == 1 else np.concatenate([*found, np.empty(0)])).reshape(-1, width)


def _piece(path: Path, rank: int, size: int) -> FloatArray:
    """Return the numbers of one of the pieces of a file: those that begin in it."""
    try:
        total = _size(path)
        begin, end = total * rank // size, total * (rank + 1) // size
        text = (
            _words(_text(path, max(begin - 1, 0), end + _LONGEST), min(begin, 1), end - begin) if begin < end else b""
        )
        return numbers_of(path, text) if text.strip() else np.empty(0)
    except (OSError, ValueError, EOFError) as error:
        read_bal(path)  # which says what is wrong, and where
        raise BalError(f"{path}: cannot be read in pieces: {error}") from error


def _words(text: bytes, before: int, length: int) -> bytes:
    """Return the words that begin in so many bytes of a text, after those before it, of which there are 0 or 1."""
    begin, end = before, before + length
    if before and not text[:1].isspace():
        begin = _blank(text, begin)
    if not text[end - 1 : end].isspace():
        end = _blank(text, end)
    return text[begin:end]


def _blank(text: bytes, at: int) -> int:
    """Return where the next blank stands, or the text ends."""
    found = re.compile(rb"\s").search(text, at)
    return found.start() if found else len(text)


def _size(path: Path) -> int:
    """Return how many bytes of text a file holds."""
    if path.suffix in _PACKED:
        return sum(map(len, _unpacked(path)))
    with opened(path, MAX_BYTES, BalError) as stream:
        return stream.seek(0, os.SEEK_END)


def _text(path: Path, begin: int, end: int) -> bytes:
    """Return some of the text of a file."""
    if path.suffix not in _PACKED:
        with opened(path, MAX_BYTES, BalError) as stream:
            stream.seek(begin)
            return stream.read(end - begin)
    kept, at = [], 0
    for data in _unpacked(path):
        kept.append(data[max(begin - at, 0) : max(end - at, 0)])
        at += len(data)
        if at >= end:
            break
    return b"".join(kept)


def _unpacked(path: Path) -> Iterator[bytes]:
    with opened(path, MAX_BYTES, BalError) as stream:
        yield from pieces(path.suffix[1:], stream, limit_for(path.stat().st_size, MAX_GROWTH))


def _counts(path: Path, head: FloatArray, n: int) -> tuple[int, int, int]:
    """Return the numbers of cameras, points and observations of a file of n numbers that begins with some."""
    sound = len(head) == 3 and bool(np.all((head == np.floor(head)) & (head >= 0) & (head <= 2**53)))
    if sound and n == 3 + head @ [_CAMERA, _POINT, _OBSERVATION]:
        return int(head[0]), int(head[1]), int(head[2])
    read_bal(path)
    raise BalError(f"{path}: cannot be read in pieces: {n} numbers")


def _require_indices(path: Path, rows: FloatArray, limits: IntArray) -> None:
    """Raise unless rows begin with a camera and a point that there are."""
    index = rows[:, :2]
    if ((index != np.floor(index)) | (index < 0) | (index >= limits)).any():
        read_bal(path)
