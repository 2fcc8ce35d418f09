# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A BAL file that several ranks read, each its share, is the file that one reads."""

from __future__ import annotations

import bz2
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ba_node.core.communicator import Communicator
from ba_node.core.problem import ProblemError
from ba_node.core.ranks import deal
from ba_node.io.bal import BalError, BalProblem, read_bal, to_problem, write_bal
from ba_node.offline.bal_share import BalShare, read_share, whole
from ba_node.offline.ranks import RanksError
from tests.ranks import on_threads


def mixed(seed: int) -> BalProblem:
    """Return a problem whose observations come in no order."""
    rng = np.random.default_rng(seed)
    n, m, count = 5, 40, 333
    point = np.concatenate([np.arange(m), rng.integers(0, m, count - m)])
    rng.shuffle(point)
    uv = rng.normal(0.0, 10.0 ** rng.integers(-9, 9, (count, 2)))
    return BalProblem(rng.normal(size=(n, 9)), rng.normal(size=(m, 3)), rng.integers(0, n, count), point, uv)


@pytest.mark.parametrize("size", [1, 2, 3, 7, 40])
@pytest.mark.parametrize("name", ["problem.txt", "problem.txt.bz2"])
def test_shares_are_what_would_be_dealt_of_the_whole(tmp_path: Path, size: int, name: str) -> None:
    write_bal(tmp_path / name, mixed(seed=size))
    expected = to_problem(read_bal(tmp_path / name))

    def work(ranks: Communicator) -> BalShare:
        return read_share(tmp_path / name, ranks)

    shares = on_threads(size, work)
    for rank, share in enumerate(shares):
        part, points = deal(expected, rank, size)
        found = to_problem(share.bal)
        assert share.first == points.start and share.n_points == expected.n_points
        for field in dataclasses.fields(found.observations):
            np.testing.assert_array_equal(
                getattr(found.observations, field.name), getattr(part.observations, field.name), field.name
            )
        for field in dataclasses.fields(found.start):
            np.testing.assert_array_equal(getattr(found.start, field.name), getattr(part.start, field.name))


def test_rank_0_puts_the_whole_together(tmp_path: Path) -> None:
    path, given = tmp_path / "problem.txt", mixed(seed=1)
    write_bal(path, given)
    together, *others = on_threads(3, lambda ranks: whole(read_share(path, ranks), ranks))
    assert together is not None and others == [None, None]
    again, before = to_problem(together), to_problem(given)
    np.testing.assert_array_equal(again.start.points, before.start.points)
    np.testing.assert_array_equal(again.observations.uv, before.observations.uv)
    np.testing.assert_array_equal(again.observations.keyframe, before.observations.keyframe)


def test_no_rank_holds_more_than_its_piece_of_the_numbers(tmp_path: Path) -> None:
    """By their count: of 333 observations each of 3 ranks turns about a third of the text into numbers."""
    path = tmp_path / "problem.txt"
    write_bal(path, mixed(seed=2))
    numbers = 3 + 4 * 333 + 9 * 5 + 3 * 40
    shares = on_threads(3, lambda ranks: read_share(path, ranks))
    assert sum(len(share.bal.observations) for share in shares) == 333
    assert all(4 * len(share.bal.observations) < 0.45 * numbers for share in shares)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text[: len(text) // 2], "truncated"),
        (lambda text: text + b" 1.0", "the file holds"),
        (lambda text: text.replace(b"\n", b"\nx", 300), "line 2: .* is not a number"),
        (lambda text: text[:0], "the file is empty"),
        (lambda text: text[:4], "expected the numbers of cameras, points, observations"),
        (lambda text: text.replace(b"\n4 ", b"\n5 ", 1), "camera index 5 out of range"),
        (lambda text: text.replace(b"5 40 333", b"5 -40 333", 1), "expected the numbers of"),
    ],
)
def test_what_is_wrong_is_told_as_one_process_does(tmp_path: Path, change: object, reason: str) -> None:
    path = tmp_path / "problem.txt"
    write_bal(path, mixed(seed=3))
    path.write_bytes(change(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(BalError, match=reason):
        read_bal(path)
    with pytest.raises((BalError, RanksError), match=reason):
        on_threads(3, lambda ranks: read_share(path, ranks))


def test_damaged_archives_and_missing_files_are_told(tmp_path: Path) -> None:
    path = tmp_path / "problem.txt.bz2"
    for content, reason in ((bz2.compress(b"1 2 3\n" * 99)[:50], "cannot be unpacked"), (None, "cannot be opened")):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises((BalError, RanksError), match=reason):
            on_threads(2, lambda ranks: read_share(path, ranks))


def test_more_ranks_than_points_are_refused(tmp_path: Path) -> None:
    write_bal(tmp_path / "problem.txt", mixed(seed=4))
    with pytest.raises((ProblemError, RanksError), match="41 ranks for 40 points: take at most one rank a point"):
        on_threads(41, lambda ranks: read_share(tmp_path / "problem.txt", ranks))
