# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ba_node.arrays import FloatArray, IdArray
from ba_node.scene.tables import IdIndex, Table, column

ids_near_the_ends = st.integers(0, 3) | st.integers(2**63 - 2, 2**63 + 2) | st.integers(2**64 - 4, 2**64 - 1)


class Pairs(Table):
    number: IdArray = column(np.uint64)
    xy: FloatArray = column(np.float64, (2,), np.nan)


def test_rows_keep_their_values_through_growth_and_forgetting() -> None:
    table = Pairs()
    for k in range(100):
        table.append(2, number=np.array([2**64 - 1 - k, k], np.uint64))
    assert len(table) == 200
    assert [int(n) for n in table.number[-2:]] == [2**64 - 100, 99]
    keep = np.arange(200) % 3 == 0
    expected = table.number[keep].copy()
    renumbered = table.keep(keep)
    assert np.array_equal(table.number, expected)
    assert renumbered[3] == 1
    assert renumbered[4] == -1
    table.append(1)
    assert np.isnan(table.xy[-1]).all()


@given(st.lists(ids_near_the_ends, unique=True), st.lists(ids_near_the_ends), st.integers(0, 8))
def test_ids_are_found_exactly_as_a_dict_would(known: list[int], asked: list[int], split: int) -> None:
    index = IdIndex()
    expected: dict[int, int] = {}
    for part in (known[:split], known[split:]):
        rows = np.arange(len(expected), len(expected) + len(part))
        index.insert(np.array(part, np.uint64), rows)
        expected.update(zip(part, rows.tolist(), strict=True))
    found = index.find(np.array(asked, np.uint64))
    assert found.tolist() == [expected.get(i, -1) for i in asked]


def test_forgotten_rows_lose_their_ids() -> None:
    index = IdIndex()
    index.insert(np.array([5, 2**64 - 1, 0], np.uint64), np.arange(3))
    index.renumber(np.array([-1, 0, 1]))
    assert index.find(np.array([0, 5, 2**64 - 1], np.uint64)).tolist() == [1, -1, 0]
    assert len(index) == 2
