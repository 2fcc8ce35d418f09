# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The problems of the experiments: Ladybug-49 from its file, a part of it, and the synthetic spheres."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node.core.problem import Problem, State
from ba_node.io.bal import BalProblem, read_bal, to_problem
from ba_node.offline.sphere_file import start_of, truth_of
from ba_node.synthetic import PRESETS, generate_sphere

# Where data sets are looked for unless --data says otherwise.
DATA = Path("..") / "shared" / "data"
LADYBUG, LADYBUG_PART = "ladybug-49", "ladybug-10"
NAMES = (LADYBUG, LADYBUG_PART, *PRESETS)
_FILES = (
    "ladybug-49-7776/problem-49-7776-pre.txt",
    *(f"problem-49-7776-pre.txt{suffix}" for suffix in ("", ".bz2", ".gz")),
)
# Of the text as it is published.
_LADYBUG_SHA256 = "96ca2845519d89d0727953d983427ab38a42c54991cd4d73e46a4221da3c61b4"
_LADYBUG_SIZES = (49, 7776, 31_843)
_FRAMES = 10
# Rises when the generator of the spheres changes, so that no old record is taken for a new one.
_GENERATOR = 1


class DataError(ValueError):
    """A data set that is not there."""


@dataclass(frozen=True)
class Posed:
    """A problem, and the truth about it where it is known.

    Attributes:
        problem: with its start.
        truth: true state, None for real data.
    """

    problem: Problem
    truth: State | None


class Library:
    """The problems by name, read or made when they are asked for."""

    def __init__(self, data: Path) -> None:
        """Remember where data sets are."""
        self._data = data
        self._latest: tuple[str, Posed] | None = None

    def identity(self, name: str) -> str:
        """Return what a problem is made of, the same on every machine and known without its file.

        Raises:
            DataError: there is no such problem.
        """
        if name in PRESETS:
            made_of = json.dumps(dataclasses.asdict(PRESETS[name]), sort_keys=True)
            return f"sphere {_GENERATOR} {made_of}"
        if name not in NAMES:
            raise DataError(f"problem {name!r} does not exist: choose one of {', '.join(NAMES)}")
        return f"{name} {_LADYBUG_SHA256}"

    def get(self, name: str) -> Posed:
        """Return a problem; the latest one is kept.

        Raises:
            DataError: there is no such problem, or its file is missing or another one.
        """
        if self._latest is None or self._latest[0] != name:
            self._latest = None
            self._latest = (name, self._make(name))
        return self._latest[1]

    def _make(self, name: str) -> Posed:
        if name in PRESETS:
            sphere = generate_sphere(PRESETS[name])
            return Posed(to_problem(start_of(sphere)), to_problem(truth_of(sphere)).start)
        self.identity(name)
        bal = read_bal(self._file())
        sizes = len(bal.cameras), len(bal.points), len(bal.observations)
        if sizes != _LADYBUG_SIZES:
            raise DataError(
                f"{self._file()}: {sizes[0]} cameras, {sizes[1]} points and {sizes[2]} observations: expected"
                f" {_LADYBUG_SIZES[0]}, {_LADYBUG_SIZES[1]} and {_LADYBUG_SIZES[2]}, the Ladybug problem of the thesis"
            )
        return Posed(to_problem(part_of(bal, _FRAMES) if name == LADYBUG_PART else bal), None)

    def _file(self) -> Path:
        for name in _FILES:
            if (self._data / name).is_file():
                return self._data / name
        raise DataError(
            f"{self._data}: the file {_FILES[1]} is not there: take problem-49-7776-pre.txt.bz2 from the Ladybug data"
            " sets of https://grail.cs.washington.edu/projects/bal/ and say with --data in which folder it is"
        )


def part_of(bal: BalProblem, n_frames: int) -> BalProblem:
    """Return the first frames of a problem with the points that two of them see (section 2.3)."""
    rows = bal.camera_index < n_frames
    seen = np.bincount(bal.point_index[rows], minlength=len(bal.points)) >= 2
    rows &= seen[bal.point_index]
    number = np.cumsum(seen) - 1
    return BalProblem(
        bal.cameras[:n_frames],
        bal.points[seen],
        bal.camera_index[rows],
        number[bal.point_index[rows]],
        bal.observations[rows],
    )
