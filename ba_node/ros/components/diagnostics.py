# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Gather how the node fares and publish it on /diagnostics once a second, by a clock that never stands still."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from pathlib import Path

from ba_node.messages.diagnostics import Health, diagnose, diagnostics_message
from ba_node.messages.topics import DIAGNOSTICS, INPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.components.base import Component, Host
from ba_node.ros.message_factory import RclpyFactory

_PERIOD_S = 1.0
# Rates are those of so many seconds.
_RATE_S = 5.0
_DEPTH = 10
_STATM = Path("/proc/self/statm")
# Counted by the node, but no fault of anyone.
_NO_FAULT = ("inactive", "paused")


class Diagnostics(Component):
    """Publishes in every state but unconfigured: that data is ignored is worth knowing too."""

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        self._factory = RclpyFactory()
        self._keyframes, self._heard_s = 0, time.monotonic()
        self._arrived = deque([(self._heard_s, Counter(host.arrived))])
        self._lost = deque([(self._heard_s, self._all_lost())])
        self._publisher = self.publisher(TOPICS[DIAGNOSTICS], qos.reliable(_DEPTH))
        self.timer(_PERIOD_S, self._tick)

    def _tick(self) -> None:
        node = self.host.node
        findings = diagnose(self._health(time.monotonic()), self.host.config)
        stamp_ns = int(node.get_clock().now().nanoseconds)
        name = node.get_fully_qualified_name()
        self._publisher.publish(diagnostics_message(self._factory, findings, name, stamp_ns))

    def _health(self, now_s: float) -> Health:
        host, node = self.host, self.host.node
        if host.arrived["keyframes"] != self._keyframes:
            self._keyframes, self._heard_s = host.arrived["keyframes"], now_s
        began_s, before = _since(self._arrived, now_s, _RATE_S, Counter(host.arrived))
        elapsed_s = max(now_s - began_s, _PERIOD_S)
        _, lost_before = _since(self._lost, now_s, host.config.diagnostics.recent_s, self._all_lost())
        return Health(
            rates_hz={topic: (host.arrived[topic] - before[topic]) / elapsed_s for topic in INPUT_TYPES},
            publishers={node.resolve_topic_name(topic): node.count_publishers(topic) for topic in INPUT_TYPES},
            silence_s=now_s - self._heard_s,
            ignoring=", ".join(sorted(host.ignoring)),
            inbox_waiting=len(host.inbox),
            inbox_size=host.config.node.inbox_size,
            # Counts of a session begin anew with it: what has become less is nothing that was lost.
            recent={name: count for name, count in (self._all_lost() - lost_before).items() if name not in _NO_FAULT},
            report=host.report and host.report.counting(host.counted),
            tf=host.tf,
            memory_mb=_resident_mb(),
            clock=host.clock,
            solver_alive=host.worker.alive,
        )

    def _all_lost(self) -> Counter[str]:
        """Return what was dropped, solved with others or turned away, by reason."""
        report = self.host.report
        lost = Counter(self.host.counted)
        if report is not None:
            lost = Counter(report.counting(self.host.counted).rejected)
            lost["coalesced"] = report.queue.coalesced
        lost["dropped"] = self.host.inbox.dropped
        return lost


def _since(
    history: deque[tuple[float, Counter[str]]], now_s: float, span_s: float, now: Counter[str]
) -> tuple[float, Counter[str]]:
    """Append the counts of now; return time and counts at the beginning of the span."""
    history.append((now_s, now))
    while len(history) > 2 and history[1][0] <= now_s - span_s:
        history.popleft()
    return history[0]


def _resident_mb() -> float:
    """Return the memory that the process holds, MB; 0 where the system does not tell."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
