# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run one solver on one problem in a process of its own."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective
from experiments.benchmarks.problem_file import Case, case_problem, read_state
from experiments.benchmarks.solvers import ROOT, Solver

# Touches 256 MB and gives them back. The host of a virtual machine hands memory out at the first touch, and may take
# back what lies idle: up to 5 ms for 2 MB. Otherwise what a solver pays depends on which one ran before it.
_TOUCH = """
import mmap
memory = mmap.mmap(-1, 256 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
if hasattr(mmap, "MADV_HUGEPAGE"):
    memory.madvise(mmap.MADV_HUGEPAGE)
piece = bytes(1 << 20)
for begin in range(0, len(memory), len(piece)):
    memory[begin : begin + len(piece)] = piece
"""


@dataclass(frozen=True)
class Limits:
    """When a solver stops: iterations, relative decrease of an accepted step, seconds until it is ended."""

    iterations: int = 100
    tolerance: float = 1e-8
    seconds: float = 60.0


@dataclass(frozen=True)
class Run:
    """What one run gave."""

    trace: tuple[tuple[float, float], ...] = ()  # (seconds since the start of the set-up, objective); empty on failure
    total_s: float = math.nan  # until the solver returned
    start_mb: float = math.nan  # memory of the process with the problem loaded
    peak_mb: float = math.nan  # the most memory it had
    checked: float = math.nan  # objective of its solution, recomputed by ba_node's numpy kernels; NaN on failure
    version: str = ""  # of the solver
    reason: str = ""  # why it stopped, or why it failed


def run(solver: Solver, file: Path, case: Case, loss: str, limits: Limits) -> Run:
    """Run and check."""
    with tempfile.TemporaryDirectory(prefix="ba_bench_") as name:
        folder = Path(name)
        trace, state = folder / "trace.json", folder / "state.bin"
        command = [*solver.command, "--problem", str(file.resolve()), "--trace", str(trace), "--state", str(state)]
        command += ["--config", solver.config, "--loss", loss, "--threads", str(solver.threads)]
        command += ["--iterations", str(limits.iterations), "--tolerance", repr(limits.tolerance)]
        subprocess.run([sys.executable, "-c", _TOUCH], check=False)
        error = _execute(command, solver.threads, limits.seconds)
        if error:
            return Run(reason=error)
        row = json.loads(trace.read_text())
        solved = read_state(state, case)
    row["trace"] = tuple((float(time), float(value)) for time, value in row["trace"])
    known = {key: row[key] for key in ("trace", "total_s", "start_mb", "peak_mb", "version", "reason")}
    return Run(**known, checked=objective(solved, loss))


def objective(case: Case, loss: str) -> float:
    """Return the objective at the start of a case; points behind a camera keep their residual."""
    problem = case_problem(case)
    return Objective(problem, SolverOptions(loss=loss, cheirality="keep")).value(problem.start)


def _execute(command: list[str], threads: int, seconds: float) -> str:
    """Return an empty string, or why it failed."""
    count = str(threads)
    environment = {
        **os.environ,
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS"), count),
    }
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, timeout=seconds, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return f"ended after {seconds:.0f} s"
    if done.returncode:
        words = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return f"failed with {done.returncode}: {words}"
    return ""
