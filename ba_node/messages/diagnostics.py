# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out how the node is doing, and say so in a ``diagnostic_msgs/DiagnosticArray``.

There is one status for each subject: inputs, queue, solver, latency, map, memory. Its level is that of the worst
finding, its message names all of them. docs/diagnostics.md lists keys and thresholds.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ba_node.config import Config, DiagnosticsConfig
from ba_node.estimate import Status
from ba_node.messages.factory import MessageFactory, header_message
from ba_node.messages.report import Report
from ba_node.messages.topics import DIAGNOSTICS, TOPICS


class Level(enum.IntEnum):
    """As in ``diagnostic_msgs/DiagnosticStatus``; a higher one is worse."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Health:
    """What is known about the node at one moment."""

    rates_hz: Mapping[str, float] = field(default_factory=dict)  # messages a second of each input topic
    publishers: Mapping[str, int] = field(default_factory=dict)  # publishers of each input topic, by its full name
    silence_s: float = 0.0  # since the last keyframe, or since the node was configured
    ignoring: str = ""  # why data is ignored, in words; empty when it is taken
    inbox_waiting: int = 0  # messages in the inbox
    inbox_size: int = 1  # how many may wait
    recent: Mapping[str, int] = field(default_factory=dict)  # what was dropped or turned away lately, by reason
    report: Report | None = None  # of the last solve; None before the first
    tf: str = ""  # what becomes of the transform map -> odom, in words
    memory_mb: float = 0.0  # resident, MB
    clock: str = ""  # what is wrong with simulated time, in words; empty if nothing is
    solver_alive: bool = True  # the solver's thread works


@dataclass
class Finding:
    """One status: its subject, what was found, and the values behind it."""

    subject: str
    values: dict[str, str]
    level: Level = Level.OK
    words: list[str] = field(default_factory=list)

    def find(self, level: Level, words: str) -> None:
        """Add something found."""
        self.level = max(self.level, level)
        self.words.append(words)

    def above(self, value: float, warn: float, error: float, words: str) -> None:
        """Find a value beyond a threshold."""
        if value > min(warn, error):
            self.find(Level.ERROR if value > error else Level.WARN, words)


def diagnose(health: Health, config: Config) -> list[Finding]:
    """Return the findings on every subject."""
    limits = config.diagnostics
    return [
        _inputs(health, limits, config.node.silence_s),
        _queue(health, limits),
        _solver(health, limits),
        _latency(health, limits),
        _map(health),
        _memory(health, limits),
    ]


def diagnostics_message(factory: MessageFactory, findings: list[Finding], node: str, stamp_ns: int) -> Any:
    """Return the message of a node with a full name."""
    statuses = [
        factory.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=bytes([finding.level]),
            name=f"{node}: {finding.subject}",
            message="; ".join(finding.words) or "ok",
            hardware_id=node,
            values=[
                factory.make("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                for key, value in finding.values.items()
            ],
        )
        for finding in findings
    ]
    return factory.make(TOPICS[DIAGNOSTICS].type_name, header=header_message(factory, stamp_ns, ""), status=statuses)


def _inputs(health: Health, limits: DiagnosticsConfig, silence_s: float) -> Finding:
    rejected = dict(health.report.rejected) if health.report else {}
    found = Finding(
        "inputs",
        {f"{topic} [Hz]": f"{rate:.1f}" for topic, rate in health.rates_hz.items()}
        | {f"publishers of {name}": str(count) for name, count in health.publishers.items()}
        | {"silence [s]": f"{health.silence_s:.1f}"}
        | {f"rejected: {reason}": str(count) for reason, count in sorted(rejected.items())},
    )
    if health.ignoring:
        found.find(Level.OK, f"data is ignored: {health.ignoring}")
    elif 0.0 < silence_s < health.silence_s:
        missing = [name for name, count in health.publishers.items() if not count]
        words = f"no keyframe for {health.silence_s:.0f} s"
        found.find(Level.STALE, f"{words}; nobody publishes {', '.join(missing)}" if missing else words)
    if health.clock:
        found.find(Level.WARN, health.clock)
    turned_away = {reason: count for reason, count in health.recent.items() if reason not in _QUEUE}
    if turned_away:
        words = ", ".join(f"{reason} {count}" for reason, count in sorted(turned_away.items()))
        found.find(Level.WARN, f"turned away in the last {limits.recent_s:.0f} s: {words}")
    return found


_QUEUE = ("dropped", "coalesced")


def _queue(health: Health, limits: DiagnosticsConfig) -> Finding:
    report = (health.report or Report()).queue
    names = ("received", "solved", "coalesced", "dropped_keyframes", "rejected_keyframes", "waiting", "dropped")
    found = Finding(
        "queue",
        {"messages waiting": str(health.inbox_waiting), "inbox size": str(health.inbox_size)}
        | {name: str(getattr(report, name)) for name in names},
    )
    if health.recent.get("dropped"):
        found.find(Level.ERROR, f"{health.recent['dropped']} messages dropped in the last {limits.recent_s:.0f} s")
    if health.recent.get("coalesced"):
        text = f"{health.recent['coalesced']} keyframes solved with a newer one in the last {limits.recent_s:.0f} s"
        found.find(Level.WARN, text)
    if health.inbox_waiting > limits.queue_warn_share * health.inbox_size:
        found.find(Level.WARN, f"{health.inbox_waiting} of {health.inbox_size} places of the inbox are taken")
    return found


def _solver(health: Health, limits: DiagnosticsConfig) -> Finding:
    if not health.solver_alive:
        return Finding("solver", {}, Level.ERROR, ["the solver's thread has ended: start the node anew"])
    if health.report is None:
        return Finding("solver", {}, words=["no solve yet"])
    report = health.report.solve
    share = report.observations / max(report.observations + report.outliers, 1)
    found = Finding(
        "solver",
        {
            "status": report.status.name,
            "reason": report.reason,
            "method": report.method,
            "solves": str(report.solve_count),
            "solve time [ms]": f"{1e3 * report.solve_time_s:.1f}",
            "iterations": f"{report.accepted_iterations} of {report.iterations} accepted",
            "rms [px]": f"{report.rms_px_after:.3f}",
            "inlier share": f"{share:.3f}",
            "keyframes free": str(report.keyframes),
            "keyframes fixed": str(report.fixed_keyframes),
            "landmarks": str(report.landmarks),
            "observations": str(report.observations),
        },
    )
    for warning in health.report.warnings:
        found.find(Level.WARN, warning)
    if report.status is Status.FAILED:
        found.find(Level.ERROR, f"the last solve failed: {report.reason}")
    elif report.status is Status.HELD:
        found.find(Level.WARN, f"the last solution was not taken: {report.reason}")
    elif not report.solve_count:
        found.find(Level.OK, "no solve yet")
    elif report.status is Status.SKIPPED:
        found.find(Level.WARN, f"the last solve was skipped: {report.reason}")
    else:
        text = f"rms {report.rms_px_after:.1f} px"
        found.above(report.rms_px_after, limits.rms_warn_px, limits.rms_error_px, text)
        text = f"only {100 * share:.0f} % of the observations are inliers"
        found.above(-share, -limits.inliers_warn_share, -limits.inliers_error_share, text)
    return found


def _latency(health: Health, limits: DiagnosticsConfig) -> Finding:
    report = (health.report or Report()).latency
    names = [f"{which}latency_{part}_s" for which in ("", "stamp_") for part in ("p50", "p95", "max")]
    found = Finding("latency", {f"{name[:-2]} [ms]": f"{1e3 * getattr(report, name):.1f}" for name in names})
    p95 = report.latency_p95_s
    found.above(p95, limits.latency_warn_s, limits.latency_error_s, f"95 % within {1e3 * p95:.0f} ms of arrival")
    return found


def _map(health: Health) -> Finding:
    report = (health.report or Report()).solve
    found = Finding(
        "map",
        {
            "session": str(report.session_id),
            "tf": health.tf,
            "correction [m]": f"{report.correction_m:.4f}",
            "correction [rad]": f"{report.correction_rad:.5f}",
        },
    )
    if report.correction_held:
        found.find(
            Level.WARN,
            f"a correction of {report.correction_m:.2f} m, {report.correction_rad:.3f} rad is held back by its gate",
        )
    return found


def _memory(health: Health, limits: DiagnosticsConfig) -> Finding:
    found = Finding("memory", {"resident [MB]": f"{health.memory_mb:.0f}"})
    text = f"{health.memory_mb:.0f} MB"
    found.above(health.memory_mb, limits.memory_warn_mb, limits.memory_error_mb, text)
    return found
