# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a problem of BAL or a scene of Bundler on the ranks of an MPI program, with checkpoints to go on from."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node import __version__
from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core import point_priors
from ba_node.core.communicator import Communicator
from ba_node.core.problem import Problem, State
from ba_node.core.ranks import RankKernels, deal
from ba_node.core.result import Result
from ba_node.core.solver import solve
from ba_node.estimate import Iteration
from ba_node.io.bal import to_problem, translated
from ba_node.io.bundler import BundlerScene, is_bundler, read_bundler
from ba_node.io.files import whole_file
from ba_node.offline.bal_share import BalShare, read_share, share_of, whole
from ba_node.offline.ranks import RanksError, together
from ba_node.offline.solve_bal import Solution, middle_if_far, totals

_AT_ONCE = 2**20  # bytes


@dataclass(frozen=True)
class Checkpoint:
    """Where a solve is written to now and then."""

    path: Path
    every: int = 5  # iterations
    resume: bool = False  # go on from what is there

    def write(self, state: State, row: Iteration, digest: str) -> None:
        """Write a state; the file is the old or the new one, never half of it."""
        numbers = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
        with whole_file(self.path) as file:
            np.savez(file, digest=digest, damping=row.damping, radius=row.radius, iteration=row.iteration, **numbers)

    def read(self, sizes: tuple[int, int], digest: str) -> tuple[State, float, float]:
        """Return the whole state, the damping and the radius to go on with; sizes: cameras and points.

        Raises:
            RanksError: there is none, it is damaged, or it is of another problem.
        """
        try:
            with self.path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                of = str(found["digest"])
                state = State(*(found[field.name] for field in dataclasses.fields(State)))
                damping, radius = float(found["damping"]), float(found["radius"])
        except OSError as error:
            raise RanksError(f"{self.path}: no checkpoint to go on from ({error}): leave --resume out") from None
        except (EOFError, KeyError, ValueError, zipfile.BadZipFile):
            raise RanksError(f"{self.path}: no checkpoint, or a damaged one: leave --resume out") from None
        if of != digest or (len(state.translation), len(state.points)) != sizes:
            raise RanksError(f"{self.path}: a checkpoint of another problem: leave --resume out, or name its file")
        return state, damping, radius


def solve_on_ranks(
    path: Path,
    options: SolverOptions,
    communicator: Communicator,
    *,
    checkpoint: Checkpoint | None = None,
    clock: Callable[[], float],
    on_iteration: Callable[[Iteration], bool] | None = None,
    warn: Callable[[str], None] = lambda _: None,
) -> Solution | None:
    """Read and solve a file together with other ranks; return the solution on rank 0, None on others.

    Every rank reads its share of the file; rank 0 has the whole at the end, to write it. ``on_iteration`` and ``warn``
    are called on rank 0 alone.

    Raises:
        BalError, BundlerError: the file cannot be read.
        ProblemError: it holds no well-formed problem, or fewer points than there are ranks.
        RanksError: files or versions of the ranks differ, or the checkpoint cannot be gone on from.
        ConfigError: the options ask for what cannot be had on several ranks.
    """
    began = clock()
    digest = together(communicator, lambda: _digest(path))
    _require_same(communicator, digest, options)
    share, origin, bundler = _read(path, communicator)
    options, kernels, problem = together(
        communicator, lambda: _prepared(share, options, digest, communicator, checkpoint)
    )
    ready = clock()

    def seen(row: Iteration) -> bool:
        if on_iteration is not None and communicator.rank == 0:
            on_iteration(row)
        if checkpoint is not None and row.iteration and row.iteration % checkpoint.every == 0:
            state = _whole(communicator, kernels.state)
            try:
                if state is not None:
                    checkpoint.write(state, row, digest)
            except OSError as error:
                warn(f"{checkpoint.path}: no checkpoint of iteration {row.iteration} ({error}); the solve goes on")
        return True

    result = solve(problem, options, clock=clock, on_iteration=seen, kernels=kernels)
    solved = clock()
    summed = totals(share.bal, problem, result.state, communicator.sum)
    state, bal = _whole(communicator, result.state), whole(share, communicator)
    if state is None or bal is None:
        return None
    result = dataclasses.replace(result, state=state)
    return Solution(
        source=str(path),
        origin=origin,
        problem=problem,
        result=result,
        options=options,
        setup_s=ready - began,
        solve_s=solved - ready,
        bal=bal,
        bundler=bundler,
        summed=summed,
    )


def _read(path: Path, communicator: Communicator) -> tuple[BalShare, FloatArray, BundlerScene | None]:
    """Return this rank's share of a file, moved by minus the origin, (3,) that, and of a scene of Bundler the whole."""
    scene = together(communicator, lambda: read_bundler(path) if is_bundler(path) else None)
    if scene is None:
        share = read_share(path, communicator)
    else:
        share = together(communicator, lambda: share_of(scene.bal, communicator.rank, communicator.size))
    points = communicator.gather(share.bal.points)
    origin = communicator.broadcast(None if points is None else middle_if_far(np.concatenate(points)))
    if origin.any():
        share = dataclasses.replace(share, bal=translated(share.bal, -origin))
    return share, origin, None if communicator.rank else scene


def _digest(path: Path) -> str:
    """Return what tells the content of a file from others."""
    found = hashlib.sha256()
    with path.open("rb") as stream:
        while data := stream.read(_AT_ONCE):
            found.update(data)
    return found.hexdigest()


class RankSolver:
    """Solve problems of rank 0 on all ranks, of which the others :meth:`serve`; used in place of ``solver.solve``."""

    def __init__(self, communicator: Communicator) -> None:
        self._ranks = communicator

    def __enter__(self) -> RankSolver:
        return self

    def __exit__(self, *_: object) -> None:
        """Let the others go."""
        for rank in range(1, self._ranks.size):
            self._ranks.send(None, rank)

    def __call__(
        self,
        problem: Problem,
        options: SolverOptions,
        *,
        clock: Callable[[], float] = lambda: 0.0,
        on_iteration: Callable[[Iteration], bool] | None = None,
        weakest: bool = False,
    ) -> Result:
        """Deal a problem and solve it; exactly, unless another linear solver is asked for, as one process would.

        Raises:
            ProblemError: there are fewer points than ranks.
            ConfigError: the options ask for what cannot be had on several ranks.
        """
        if options.linear_solver == "auto":
            options = dataclasses.replace(options, linear_solver="cholesky")
        whole = problem if problem.point_priors is None else point_priors.as_observations(problem)
        own, _ = deal(whole, 0, self._ranks.size)
        for rank in range(1, self._ranks.size):
            self._ranks.send((deal(whole, rank, self._ranks.size)[0], options, weakest), rank)
        result = self._part_of(own, options, weakest, clock, on_iteration)
        assert result is not None
        if problem.point_priors is None:
            return result
        return dataclasses.replace(result, state=point_priors.without(result.state, problem))

    def serve(self) -> None:
        """Solve this rank's parts of what rank 0 solves, until it is done."""
        while (work := self._ranks.receive()) is not None:
            # What is wrong with a problem is said on rank 0.
            with contextlib.suppress(ValueError):
                self._part_of(*work)

    def _part_of(
        self,
        part: Problem,
        options: SolverOptions,
        weakest: bool,
        clock: Callable[[], float] = lambda: 0.0,
        on_iteration: Callable[[Iteration], bool] | None = None,
    ) -> Result | None:
        """Solve together with the others; return the whole result on rank 0."""
        options = _share_of_threads(options, self._ranks.size)
        kernels = together(self._ranks, lambda: RankKernels(part, options, self._ranks))
        result = solve(part, options, clock=clock, on_iteration=on_iteration, kernels=kernels, weakest=weakest)
        state = _whole(self._ranks, result.state)
        return None if state is None else dataclasses.replace(result, state=state)


def _whole(communicator: Communicator, state: State) -> State | None:
    """Return a state with the points of all ranks on rank 0, None on others."""
    parts = communicator.gather(state.points)
    return None if parts is None else dataclasses.replace(state, points=np.concatenate(parts))


def _share_of_threads(options: SolverOptions, size: int) -> SolverOptions:
    """Return options that give each of the ranks of this machine its cores where threads are left open."""
    if options.threads:
        return options
    return dataclasses.replace(options, threads=max(1, len(os.sched_getaffinity(0)) // size))


def _prepared(
    share: BalShare, options: SolverOptions, digest: str, communicator: Communicator, checkpoint: Checkpoint | None
) -> tuple[SolverOptions, _Watched, Problem]:
    """Return options, kernels and problem of this rank."""
    problem = to_problem(share.bal)
    if checkpoint is not None and checkpoint.resume:
        start, damping, radius = checkpoint.read((problem.n_keyframes, share.n_points), digest)
        points = start.points[share.first : share.first + problem.n_points].copy()
        problem = dataclasses.replace(problem, start=dataclasses.replace(start, points=points))
        # The damping of a run without any stays as it was; a radius without a region is infinite.
        options = dataclasses.replace(
            options,
            initial_damping=damping or options.initial_damping,
            initial_radius=radius if np.isfinite(radius) else options.initial_radius,
        )
    options = _share_of_threads(options, communicator.size)
    return options, _Watched(problem, options, communicator), problem


class _Watched(RankKernels):
    """Kernels that know where the solve is."""

    state: State

    def linearise(self, state: State) -> float:
        """Linearise at a state; every state that a solve has taken comes here."""
        # The kernels may write over it later.
        self.state = dataclasses.replace(
            state, **{f.name: getattr(state, f.name).copy() for f in dataclasses.fields(state)}
        )
        return super().linearise(state)


def _require_same(communicator: Communicator, digest: str, options: SolverOptions) -> None:
    """Raise unless all ranks have the same file, version and options."""
    told = communicator.gather((__version__, digest, options))
    problem = ""
    if told is not None:
        for what, values in zip(("versions of ba_node", "files", "options"), zip(*told, strict=True), strict=True):
            other = next((rank for rank, value in enumerate(values) if value != values[0]), None)
            if other is not None and not problem:
                problem = f"ranks 0 and {other} have different {what}: give all ranks the same"
    problem = communicator.broadcast(problem)
    if problem:
        raise RanksError(problem)
