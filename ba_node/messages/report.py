# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put a ``ba_msgs/SolverReport`` together from its parts: the solve, the queue before it, and the latency after it.

The back-end fills the first, the node's worker the second, whoever publishes the third. A replay has the first alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ba_node.estimate import SolveReport
from ba_node.messages.factory import MessageFactory, header_message
from ba_node.messages.topics import OUTPUT_TYPES


@dataclass(frozen=True)
class QueueReport:
    """What became of the keyframes that came in (fields of ``ba_msgs/SolverReport``), and what the node adds."""

    queue_wait_s: float = 0.0
    dropped: int = 0
    coalesced: int = 0
    received: int = 0
    solved: int = 0
    dropped_keyframes: int = 0
    rejected_keyframes: int = 0
    waiting: int = 0
    rejected: Mapping[str, int] = field(default_factory=dict)  # what the node itself turned away, by reason
    warnings: tuple[str, ...] = ()  # what the node has to say


@dataclass(frozen=True)
class LatencyReport:
    """How old results are when they leave (fields of ``ba_msgs/SolverReport``), s."""

    latency_p50_s: float = 0.0
    latency_p95_s: float = 0.0
    latency_max_s: float = 0.0
    stamp_latency_p50_s: float = 0.0
    stamp_latency_p95_s: float = 0.0
    stamp_latency_max_s: float = 0.0


@dataclass(frozen=True)
class Report:
    """A whole report."""

    solve: SolveReport = field(default_factory=SolveReport)
    queue: QueueReport = field(default_factory=QueueReport)
    latency: LatencyReport = field(default_factory=LatencyReport)

    def counting(self, counted: Mapping[str, int]) -> Report:
        """Return a report with more of what the node turned away."""
        return replace(self, queue=replace(self.queue, rejected={**self.queue.rejected, **counted}))

    @property
    def rejected(self) -> dict[str, int]:
        """Return what was turned away, by reason."""
        return {**self.solve.rejected, **self.queue.rejected}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what somebody has to know, in words."""
        return (*self.solve.warnings, *self.queue.warnings)


def report_message(factory: MessageFactory, report: Report, stamp_ns: int, frame_id: str) -> Any:
    """Return the message of a report, with the stamp of the newest keyframe and the frame of the map."""
    fields = vars(report.solve) | vars(report.queue) | vars(report.latency)
    del fields["rejected"]
    rejected = dict(sorted(report.rejected.items()))
    return factory.make(
        OUTPUT_TYPES["report"],
        header=header_message(factory, stamp_ns, frame_id),
        rejected_reason=list(rejected),
        rejected_count=factory.array(np.array(list(rejected.values()), dtype=np.uint64)),
        **(fields | {"status": int(report.solve.status), "warnings": list(report.warnings)}),
    )
