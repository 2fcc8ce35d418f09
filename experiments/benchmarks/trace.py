# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What every solver process is told and what it writes: one command line, one JSON file."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.benchmarks.problem_file import Case, read_case


@dataclass
class Recorder:
    """The clock, the memory and the trace of one run. It starts when the problem is in memory."""

    began: float = field(default_factory=time.perf_counter)  # clock at the start of the set-up, s
    start_mb: float = field(default_factory=lambda: memory_mb("VmRSS"))  # memory of the process then
    # (seconds since began, objective) after each iteration; the first row is the start
    trace: list[tuple[float, float]] = field(default_factory=list)

    def add(self, objective: float) -> None:
        """Note an objective that has just been reached."""
        self.trace.append((time.perf_counter() - self.began, float(objective)))

    def write(self, path: Path, version: str, reason: str, **more: Any) -> None:
        """Write the trace; call it right after the solve, for the total."""
        row = {"version": version, "reason": reason, "total_s": time.perf_counter() - self.began}
        row |= {"start_mb": self.start_mb, "peak_mb": memory_mb("VmHWM"), "trace": self.trace, **more}
        path.write_text(json.dumps(row))


def memory_mb(name: str) -> float:
    """Return VmRSS (now) or VmHWM (the most so far) of this process, without what its parent had; 0 if unknown."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) / 1024.0 for line in lines if line.startswith(f"{name}:")), 0.0)


def arguments(doc: str) -> tuple[argparse.Namespace, Case]:
    """Return the arguments that every solver takes, and the problem."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--problem", type=Path, required=True)
    parser.add_argument("--trace", type=Path, required=True)
    parser.add_argument("--state", type=Path, required=True)
    parser.add_argument("--config", default="")
    parser.add_argument("--loss", choices=("squared", "huber"), default="squared")
    parser.add_argument("--scale", type=float, default=1.0, help="where Huber's loss leaves the square, px")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--tolerance", type=float, default=1e-8, help="relative decrease at which to stop")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    return args, read_case(args.problem)
