# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep columns of numbers that grow row by row, and find rows by a 64-bit id.

Ids may be any uint64, 0 and 2^64 - 1 included. Mixing uint64 with int64 makes numpy compute in float64, which
tells 2^64 - 1 from 2^64 - 2 no longer; so ids are only ever sorted, compared and searched, as uint64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ba_node.arrays import BoolArray, IdArray, IntArray


class Column(NamedTuple):
    """Type of one row's entry, its shape, and what a new row holds if nothing is given."""

    dtype: DTypeLike
    shape: tuple[int, ...] = ()
    fill: float = 0


def column(dtype: DTypeLike, shape: tuple[int, ...] = (), fill: float = 0) -> Any:
    """Declare an attribute of a Table as one of its columns."""
    return Column(dtype, shape, fill)


# Rows are copied by pieces of so many.
_PIECE = 512


class Piece(dict[str, NDArray[Any]]):
    """Columns of some rows in a row as they were at a moment; nobody changes them."""

    made: Any = None  # what a reader has made of them, for the next


@dataclass(frozen=True)
class Rows:
    """Rows of some columns as they were at a moment, in pieces that later moments share where nothing changed."""

    pieces: tuple[Piece, ...]

    def take(self, name: str, rows: IntArray) -> NDArray[Any]:
        """Return a column at some rows."""
        first, last = int(rows.min(initial=0)) // _PIECE, int(rows.max(initial=0)) // _PIECE
        column = np.concatenate([piece[name] for piece in self.pieces[first : last + 1]])
        return column[rows - first * _PIECE]


class Table:
    """Columns of equal length. A subclass declares each as an attribute with :func:`column`.

    The attributes are views of the rows in use; writing to them changes the table. They are replaced when the table
    grows or shrinks, so nobody may hold on to one. Who changes a column that is in :attr:`COPIED` calls
    :meth:`changed`.
    """

    COLUMNS: ClassVar[Mapping[str, Column]] = {}
    COPIED: ClassVar[tuple[str, ...]] = ()
    _FILLS: ClassVar[dict[str, object]] = {}  # what is not zero of a row of which nothing is given

    def __init_subclass__(cls) -> None:
        """Find the columns."""
        cls.COLUMNS = {name: value for name, value in vars(cls).items() if isinstance(value, Column)}
        cls._FILLS = {name: value.fill for name, value in cls.COLUMNS.items() if value.fill != 0}

    def __init__(self) -> None:
        self._size = self._room = 0
        self._buffers: dict[str, NDArray[Any]] = {
            name: np.empty((0, *column.shape), column.dtype) for name, column in self.COLUMNS.items()
        }
        self._pieces: list[Piece] = []
        self._stale = np.ones(1, bool)
        self._expose()

    def __len__(self) -> int:
        return self._size

    def append(self, count: int, **values: object) -> IntArray:
        """Add rows at the end and return their numbers; room grows by doubling, so adding is O(1) a row."""
        begin, end = self._size, self._size + count
        if not count:
            return np.arange(begin, end)
        if end > self._room:
            self._grow(max(end, 2 * self._room, 16))
        for name, value in (self._FILLS | values).items():
            self._buffers[name][begin:end] = value
        self._size = end
        self._expose()
        if self.COPIED:
            self._mark(slice(begin // _PIECE, -(-end // _PIECE)))
        return np.arange(begin, end)

    def keep(self, rows: BoolArray) -> IntArray:
        """Forget all rows but those marked, and return the new number of every old row, -1 for the forgotten."""
        renumbered = np.where(rows, np.cumsum(rows) - 1, -1)
        for name in self.COLUMNS:
            self._buffers[name] = self._buffers[name][: self._size][rows]
        self._size = self._room = int(np.count_nonzero(rows))
        self._expose()
        self.changed()
        return renumbered

    def changed(self, rows: IntArray | slice = slice(None)) -> None:
        """Note that rows are to be copied anew, by default all."""
        if not self.COPIED:
            return
        if isinstance(rows, slice):
            self._pieces, self._stale = [], np.ones(self._n_pieces, bool)
        elif len(rows):
            self._mark(np.asarray(rows) // _PIECE)

    def clone(self: _Table) -> _Table:
        """Return a table of its own with the same rows."""
        other = type(self)()
        other.append(self._size, **self.columns())
        return other

    def columns(self, rows: BoolArray | slice = slice(None)) -> dict[str, NDArray[Any]]:
        """Return all columns, of some rows, as :meth:`append` takes them."""
        return {name: getattr(self, name)[rows] for name in self.COLUMNS}

    def copy(self) -> Rows:
        """Return a copy of the columns in ``COPIED``; it costs as much as has changed since the last."""
        for k in np.flatnonzero(self._stale).tolist():
            rows = slice(k * _PIECE, min((k + 1) * _PIECE, self._size))
            piece = Piece((name, np.array(self._buffers[name][rows])) for name in self.COPIED)
            self._pieces[k : k + 1] = [piece]
        self._stale[:] = False
        return Rows(tuple(self._pieces))

    def _mark(self, pieces: IntArray | slice) -> None:
        """Note that pieces are to be copied anew."""
        missing = self._n_pieces - len(self._stale)
        if missing > 0:
            self._stale = np.append(self._stale, np.ones(missing, bool))
        self._stale[pieces] = True

    @property
    def _n_pieces(self) -> int:
        return max(1, -(-self._size // _PIECE))

    def _grow(self, room: int) -> None:
        """Make room, all zero."""
        for name, column in self.COLUMNS.items():
            grown = np.zeros((room, *column.shape), column.dtype)
            grown[: self._size] = self._buffers[name][: self._size]
            self._buffers[name] = grown
        self._room = room

    def _expose(self) -> None:
        for name, buffer in self._buffers.items():
            setattr(self, name, buffer[: self._size])


_Table = TypeVar("_Table", bound=Table)


class Growing:
    """An array that grows at its end; what was taken of it before stays as it is."""

    def __init__(self, dtype: DTypeLike, values: Any = ()) -> None:
        self._buffer: NDArray[Any] = np.array(values, dtype)
        self.values = self._buffer

    def extend(self, values: NDArray[Any]) -> None:
        """Add some at the end."""
        begin, end = len(self.values), len(self.values) + len(values)
        if end > len(self._buffer):
            self._buffer = np.concatenate([self.values, np.empty(end, self._buffer.dtype)])
        self._buffer[begin:end] = values
        self.values = self._buffer[:end]


# So many ids, or such a share of all, are kept apart before they are merged.
_FEW, _FEW_SHARE = 1024, 8


class IdIndex:
    """Row numbers by id: sorted ids, searched by bisection.

    New ids that come before others are few: they are kept apart, sorted too, and merged once they are many.
    """

    def __init__(self) -> None:
        self._ids, self._of = Growing(np.uint64), Growing(np.intp)
        self._few: IdArray = np.empty(0, np.uint64)
        self._few_rows: IntArray = np.empty(0, np.intp)

    def __len__(self) -> int:
        return len(self._ids.values) + len(self._few)

    def find(self, ids: IdArray) -> IntArray:
        """Return the row of each id, -1 where it is not known."""
        found = _found(self._ids.values, self._of.values, ids)
        return np.maximum(found, _found(self._few, self._few_rows, ids)) if len(self._few) else found

    def insert(self, ids: IdArray, rows: IntArray) -> None:
        """Add ids that are not known yet and differ from each other."""
        order = np.argsort(ids)
        ids, rows = ids[order], rows[order]
        known = self._ids.values
        # Most front-ends count: new ids come last.
        begin = int(np.searchsorted(ids, known[-1])) if len(known) else 0
        self._ids.extend(ids[begin:])
        self._of.extend(rows[begin:])
        if begin:
            at = np.searchsorted(self._few, ids[:begin])
            self._few, self._few_rows = (
                np.insert(self._few, at, ids[:begin]),
                np.insert(self._few_rows, at, rows[:begin]),
            )
            if len(self._few) > max(_FEW, len(known) // _FEW_SHARE):
                self._merge()

    def renumber(self, renumbered: IntArray) -> None:
        """Follow :meth:`Table.keep`: take over the new row numbers and drop ids whose row is gone."""
        self._merge()
        rows = renumbered[self._of.values]
        self._set(self._ids.values[rows >= 0], rows[rows >= 0])

    def _merge(self) -> None:
        if len(self._few):
            at = np.searchsorted(self._ids.values, self._few)
            self._set(np.insert(self._ids.values, at, self._few), np.insert(self._of.values, at, self._few_rows))
            self._few, self._few_rows = self._few[:0], self._few_rows[:0]

    def _set(self, ids: IdArray, rows: IntArray) -> None:
        self._ids, self._of = Growing(np.uint64, ids), Growing(np.intp, rows)


def _found(known: IdArray, rows: IntArray, ids: IdArray) -> IntArray:
    if not len(known):
        return np.full(len(ids), -1)
    at = known.searchsorted(ids)
    return np.where(known.take(at, mode="clip") == ids, rows.take(at, mode="clip"), -1)
