# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The problems of the benchmarks: which exist, in which sets they take part, and how each is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node.config import SolverOptions
from ba_node.core.cameras import MIN_DEPTH
from ba_node.core.objective import Objective
from ba_node.io.bal import read_bal
from experiments.benchmarks.generators import loop, sphere, window
from experiments.benchmarks.problem_file import Case, case_problem, read_case, sorted_by_point, write_case

# Where data sets are looked for unless --data says otherwise; see docs/performance.md.
DATA = Path("data")
# Rises when a generator changes, so that no old file is taken for a new one.
_VERSION = 4
_LADYBUG = "ladybug-49-7776/problem-49-7776-pre.txt"
_DUBROVNIK = "gtsam-dubrovnik-small/"


@dataclass(frozen=True)
class Problem:
    """One problem under one loss."""

    name: str  # unique
    source: str  # file or name that the case is made from; cases with the same source share their file
    make: Callable[[Path], Case]  # from the data folder to the case
    loss: str  # squared or huber (1 px)
    sets: tuple[str, ...] = ("default",)  # of quick, default, large
    family: str = ""  # with others of which the growth with size is fitted, or empty
    needs: str = ""  # file in the data folder, or empty


def _window(n: int, loss: str, *sets: str) -> Problem:
    family = "window" if loss == "huber" else ""
    return Problem(f"window-{n} {loss}", f"window-{n}", lambda _: window(n), loss, sets, family)


def _loop(n: int, loss: str, *sets: str) -> Problem:
    family = "loop" if loss == "squared" else ""
    return Problem(f"loop-{n} {loss}", f"loop-{n}", lambda _: loop(n, 100 * n), loss, sets, family)


def _file(name: str, path: str, loss: str, *, in_front: bool = False) -> Problem:
    def make(data: Path) -> Case:
        case = Case(sorted_by_point(read_bal(data / path)), 0, 9)
        return _in_front(case) if in_front else case

    return Problem(f"{name} {loss}", name, make, loss, ("default",), "", path)


def _in_front(case: Case) -> Case:
    """Return the case without observations of points that start behind their camera, nor points seen less than twice.

    Solvers that leave such observations out by themselves have the same objective as the others here.
    """
    problem = case_problem(case)
    keep = Objective(problem, SolverOptions()).in_camera(problem.start)[:, 2] > MIN_DEPTH
    bal = case.bal
    keep &= np.bincount(bal.point_index[keep], minlength=len(bal.points))[bal.point_index] >= 2
    points, renumbered = np.unique(bal.point_index[keep], return_inverse=True)
    bal = dataclasses.replace(
        bal,
        points=bal.points[points],
        camera_index=bal.camera_index[keep],
        point_index=renumbered.reshape(-1),
        observations=bal.observations[keep],
    )
    return dataclasses.replace(case, bal=bal)


PROBLEMS = (
    _window(20, "huber", "quick", "default"),
    _window(20, "squared", "default"),
    _window(5, "huber", "quick", "default"),
    *(_window(n, "huber", "default") for n in (10, 30, 40, 50)),
    _file("ladybug-49", _LADYBUG, "squared"),
    _file("ladybug-49", _LADYBUG, "huber"),
    _file("ladybug-49-front", _LADYBUG, "squared", in_front=True),
    _file("dubrovnik-1-1", _DUBROVNIK + "dubrovnik-1-1-pre.txt", "squared"),
    _file("dubrovnik-3-7", _DUBROVNIK + "dubrovnik-3-7-pre.txt", "squared"),
    _file("dubrovnik-3-7-18", _DUBROVNIK + "dubrovnik-3-7-18-pre.txt", "squared"),
    Problem("sphere-50 squared", "sphere-50", lambda _: sphere("50-1000"), "squared"),
    _loop(50, "squared", "default"),
    _loop(100, "squared", "default"),
    _loop(200, "squared", "default"),
    _loop(200, "huber", "default"),
    _loop(1000, "squared", "large"),
    _loop(5000, "squared", "large"),
)


def chosen(names: list[str], sets: set[str]) -> list[Problem]:
    """Return the problems whose name contains one of ``names``, or without names those of the sets.

    Raises:
        ValueError: a name that no problem contains.
    """
    for name in names:
        if not any(name in problem.name for problem in PROBLEMS):
            raise ValueError(f"no problem is called {name!r}: {', '.join(p.name for p in PROBLEMS)}")
    if names:
        return [problem for problem in PROBLEMS if any(name in problem.name for name in names)]
    return [problem for problem in PROBLEMS if sets & set(problem.sets)]


def prepare(problem: Problem, data: Path, folder: Path) -> tuple[Path, Case] | None:
    """Return file and case of a problem, made now or before; None if its data is not there."""
    if problem.needs and not (data / problem.needs).is_file():
        return None
    path = folder / f"{problem.source}-v{_VERSION}.bin"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        write_case(part, problem.make(data))
        part.replace(path)
    return path, read_case(path)
