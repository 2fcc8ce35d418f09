# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is measured of a long run: memory and time a keyframe, in parts of equal length, and whether they grow."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PAGE_KB = 4
# Parts at the beginning in which tables fill up to their bounds, as a share of all.
_FILLING = 0.5
MORE_MB, MORE_SHARE, MORE_TIME = 20.0, 0.05, 1.5


def resident_mb(process: int | str = "self") -> float:
    """Return the memory of a process, MB."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * PAGE_KB / 1024.0


def processor_s(process: int | str = "self") -> float:
    """Return the processor time that a process has taken, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Part:
    """A stretch of a run.

    Attributes:
        keyframes: sent up to its end.
        memory_mb: at its end.
        times_ms: from a keyframe to its estimate, of each in it.
        cost_ms: processor time of a keyframe.
    """

    keyframes: int
    memory_mb: float
    times_ms: Sequence[float]
    cost_ms: float

    def row(self) -> str:
        """Return a line for the terminal."""
        p50, p95 = np.percentile(self.times_ms, [50, 95])
        times = f"p50 {p50:6.2f} ms  p95 {p95:6.2f} ms  processor {self.cost_ms:6.2f} ms"
        return f"{self.keyframes:8} keyframes  {self.memory_mb:7.1f} MB  {times}"


def growth(parts: Sequence[Part], timed: bool) -> list[str]:
    """Return what grows from the middle of a run to its end, in words; empty if nothing does."""
    early, late = parts[int(_FILLING * len(parts))], parts[-1]
    found = []
    if late.memory_mb > (1.0 + MORE_SHARE) * early.memory_mb + MORE_MB:
        found.append(f"memory: {early.memory_mb:.0f} MB, then {late.memory_mb:.0f} MB")
    if timed and late.cost_ms > MORE_TIME * early.cost_ms:
        found.append(f"processor time of a keyframe: {early.cost_ms:.2f} ms, then {late.cost_ms:.2f} ms")
    return found
