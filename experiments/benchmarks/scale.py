# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how a solve goes with ranks: ``mpiexec -n N python -m experiments.benchmarks.scale PROBLEM``.

Each rank makes its own part (streams.py) and solves with one thread by PCG. Written as JSON, of the slowest rank:
processor time (that of one rank does not count time for which others had the core), bytes summed over ranks, memory.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse.linalg  # noqa: F401 -- otherwise the first solve would wait for it

from ba_node.arrays import FloatArray
from ba_node.core import methods
from ba_node.core.communicator import Communicator
from ba_node.core.ranks import RankKernels
from ba_node.core.solver import solve
from ba_node.offline.ranks import world
from experiments.benchmarks.streams import named


class Counted:
    """Ranks that count what they tell each other; time spent waiting is not that of work."""

    def __init__(self, ranks: Communicator) -> None:
        self._ranks, self.rank, self.size, self.neighbours = ranks, ranks.rank, ranks.size, ranks.neighbours
        self.bytes, self.calls, self.busy_s, self.wall_s = 0, 0, 0.0, 0.0
        self.send, self.receive, self.abort, self.finish = ranks.send, ranks.receive, ranks.abort, ranks.finish

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sum over ranks."""
        return np.asarray(self._counted(self._ranks.sum, values, values.nbytes))

    def gather(self, value: Any) -> list[Any] | None:
        """Return the values of all ranks on rank 0."""
        found: list[Any] | None = self._counted(self._ranks.gather, value, _size(value))
        return found

    def broadcast(self, value: Any) -> Any:
        """Return the value of rank 0."""
        return self._counted(self._ranks.broadcast, value, _size(value))

    def exchange(self, parts: Sequence[Any]) -> list[Any]:
        """Send each rank its part; return what each has sent to this one."""
        sent = sum(_size(part) for rank, part in enumerate(parts) if rank != self.rank)
        found: list[Any] = self._counted(self._ranks.exchange, parts, sent)
        return found

    def _counted(self, call: Any, value: Any, size: int) -> Any:
        began, busy = time.perf_counter(), time.process_time()
        found = call(value)
        self.wall_s += time.perf_counter() - began
        self.busy_s += time.process_time() - busy
        self.bytes, self.calls = self.bytes + size, self.calls + 1
        return found


def _size(value: Any) -> int:
    """Return about how many bytes a value has."""
    if isinstance(value, (list, tuple)):
        return sum(map(_size, value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    arrays = (getattr(value, name, None) for name in ("data", "indices", "indptr"))
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def measure(name: str, iterations: int, settings: dict[str, Any]) -> dict[str, Any] | None:
    """Make and solve a problem; return what was measured on rank 0, None on others."""
    ranks = Counted(world())
    part = named(name).part(ranks.rank, ranks.size)
    made_mb = _peak_mb()
    options = dataclasses.replace(
        methods.options("auto"), linear_solver="pcg", threads=1, max_iterations=iterations, **settings
    )
    began, busy = time.perf_counter(), time.process_time()
    result = solve(part, options, clock=time.process_time, kernels=RankKernels(part, options, ranks))
    own = {
        "cpu_s": time.process_time() - busy,
        "talk_cpu_s": ranks.busy_s,
        "wall_s": time.perf_counter() - began,
        "observations": len(part.observations),
        "peak_mb": _peak_mb(),
        "made_mb": made_mb,
    }
    told = ranks.gather(own)
    if told is None:
        return None
    worst = {key: max(row[key] for row in told) for key in own if key != "observations"}
    return {
        "problem": name,
        "ranks": ranks.size,
        **worst,
        "work_s": max(row["cpu_s"] - row["talk_cpu_s"] for row in told),
        "observations": sum(row["observations"] for row in told),
        "sums": ranks.calls,
        "mb_told": ranks.bytes / 1e6,
        "iterations": len(result.trace) - 1,
        "pcg_steps": sum(row.linear_iterations for row in result.trace),
        "objective": [result.trace[0].objective, result.trace[-1].objective],
        "linear_solver": result.linear_solver,
    }


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Measure one problem."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", help="ladybug-1723, venice-1778, final-13682, or street:N, city:N, loop:N")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--preconditioner", default="auto")
    args = parser.parse_args()
    found = measure(args.problem, args.iterations, {"preconditioner": args.preconditioner})
    if found is not None:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
