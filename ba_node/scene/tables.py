# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep columns of numbers that grow row by row, and find rows by a 64-bit id.

Ids may be any uint64, 0 and 2^64 - 1 included. Mixing uint64 with int64 makes numpy compute in float64, which
tells 2^64 - 1 from 2^64 - 2 no longer; so ids are only ever sorted, compared and searched, as uint64.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

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


class Table:
    """Columns of equal length. A subclass declares each as an attribute with :func:`column`.

    The attributes are views of the rows in use; writing to them changes the table. They are replaced when the table
    grows or shrinks, so nobody may hold on to one.
    """

    COLUMNS: ClassVar[Mapping[str, Column]] = {}

    def __init_subclass__(cls) -> None:
        """Find the columns."""
        cls.COLUMNS = {name: value for name, value in vars(cls).items() if isinstance(value, Column)}

    def __init__(self) -> None:
        self._size = 0
        self._buffers: dict[str, NDArray[Any]] = {
            name: np.empty((0, *column.shape), column.dtype) for name, column in self.COLUMNS.items()
        }
        self._expose()

    def __len__(self) -> int:
        return self._size

    def append(self, count: int, **values: object) -> IntArray:
        """Add rows at the end and return their numbers; room grows by doubling, so adding is O(1) a row."""
        begin, end = self._size, self._size + count
        for name, column in self.COLUMNS.items():
            buffer = self._buffers[name]
            if end > len(buffer):
                grown = np.empty((max(end, 2 * len(buffer), 16), *column.shape), column.dtype)
                grown[:begin] = buffer[:begin]
                self._buffers[name] = grown
            self._buffers[name][begin:end] = values.get(name, column.fill)
        self._size = end
        self._expose()
        return np.arange(begin, end)

    def keep(self, rows: BoolArray) -> IntArray:
        """Forget all rows but those marked, and return the new number of every old row, -1 for the forgotten."""
        renumbered = np.where(rows, np.cumsum(rows) - 1, -1)
        for name in self.COLUMNS:
            self._buffers[name] = self._buffers[name][: self._size][rows]
        self._size = int(np.count_nonzero(rows))
        self._expose()
        return renumbered

    def _expose(self) -> None:
        for name, buffer in self._buffers.items():
            setattr(self, name, buffer[: self._size])


class IdIndex:
    """Row numbers by id: sorted ids, searched by bisection."""

    def __init__(self) -> None:
        self._ids: IdArray = np.empty(0, np.uint64)
        self.rows: IntArray = np.empty(0, np.intp)

    def __len__(self) -> int:
        return len(self._ids)

    def find(self, ids: IdArray) -> IntArray:
        """Return the row of each id, -1 where it is not known."""
        if not len(self._ids):
            return np.full(len(ids), -1)
        at = np.minimum(np.searchsorted(self._ids, ids), len(self._ids) - 1)
        return np.where(self._ids[at] == ids, self.rows[at], -1)

    def insert(self, ids: IdArray, rows: IntArray) -> None:
        """Add ids that are not known yet and differ from each other."""
        order = np.argsort(ids)
        ids, rows = ids[order], rows[order]
        if len(self._ids) and len(ids) and ids[0] < self._ids[-1]:
            at = np.searchsorted(self._ids, ids)
            self._ids, self.rows = np.insert(self._ids, at, ids), np.insert(self.rows, at, rows)
        else:
            # Most front-ends count: new ids come last.
            self._ids, self.rows = np.concatenate([self._ids, ids]), np.concatenate([self.rows, rows])

    def renumber(self, renumbered: IntArray) -> None:
        """Follow :meth:`Table.keep`: take over the new row numbers and drop ids whose row is gone."""
        rows = renumbered[self.rows]
        self._ids, self.rows = self._ids[rows >= 0], rows[rows >= 0]
