# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from ba_node.config import Config, DiagnosticsConfig
from ba_node.estimate import SolveReport, Status
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.messages.diagnostics import Finding, Health, Level, diagnose, diagnostics_message
from ba_node.messages.report import LatencyReport, Report

GOOD = SolveReport(
    status=Status.CONVERGED,
    solve_count=3,
    rms_px_after=0.5,
    observations=900,
    outliers=100,
    keyframes=20,
    rejected={"bad_pose": 2},
)
HEALTHY = Health(
    rates_hz={"keyframes": 10.0},
    publishers={"/car/keyframes": 1, "/car/feature_tracks": 1},
    silence_s=0.1,
    inbox_size=500,
    report=Report(GOOD, latency=LatencyReport(latency_p95_s=0.02)),
    tf="map -> odom",
    memory_mb=200.0,
)


def findings(**changes: Any) -> dict[str, Finding]:
    solve = {name: changes.pop(name) for name in list(changes) if name in SolveReport.__dataclass_fields__}
    latency = LatencyReport(latency_p95_s=changes.pop("latency_p95_s", 0.02))
    report = Report(dataclasses.replace(GOOD, **solve), latency=latency)
    health = dataclasses.replace(HEALTHY, **({"report": report} | changes))
    return {finding.subject: finding for finding in diagnose(health, Config())}


def test_all_is_well() -> None:
    found = findings()
    assert list(found) == ["inputs", "queue", "solver", "latency", "map", "memory"]
    assert {finding.level for finding in found.values()} == {Level.OK}
    assert found["inputs"].values["keyframes [Hz]"] == "10.0"
    assert found["inputs"].values["rejected: bad_pose"] == "2"
    assert found["solver"].values["inlier share"] == "0.900"
    assert found["solver"].values["keyframes free"] == "20"
    assert found["latency"].values["latency_p95 [ms]"] == "20.0"


@pytest.mark.parametrize(
    ("changes", "subject", "level", "words"),
    [
        ({"silence_s": 17.0}, "inputs", Level.STALE, "no keyframe for 17 s"),
        (
            {"silence_s": 17.0, "publishers": {"/car/keyframes": 0, "/car/feature_tracks": 2}},
            "inputs",
            Level.STALE,
            "nobody publishes /car/keyframes",
        ),
        ({"silence_s": 17.0, "ignoring": "inactive"}, "inputs", Level.OK, "data is ignored: inactive"),
        ({"recent": {"bad_pose": 2}}, "inputs", Level.WARN, "turned away in the last 10 s: bad_pose 2"),
        ({"recent": {"dropped": 4}}, "queue", Level.ERROR, "4 messages dropped in the last 10 s"),
        ({"recent": {"coalesced": 4}}, "queue", Level.WARN, "4 keyframes solved with a newer one"),
        ({"clock": "no time"}, "inputs", Level.WARN, "no time"),
        ({"solver_alive": False}, "solver", Level.ERROR, "the solver's thread has ended"),
        ({"inbox_waiting": 300}, "queue", Level.WARN, "300 of 500 places"),
        ({"status": Status.FAILED, "reason": "no luck"}, "solver", Level.ERROR, "the last solve failed: no luck"),
        ({"status": Status.SKIPPED, "reason": "no rig"}, "solver", Level.WARN, "skipped: no rig"),
        ({"report": None}, "solver", Level.OK, "no solve yet"),
        ({"rms_px_after": 3.0}, "solver", Level.WARN, "rms 3.0 px"),
        ({"rms_px_after": 30.0}, "solver", Level.ERROR, "rms 30.0 px"),
        ({"outliers": 900}, "solver", Level.WARN, "only 50 % of the observations are inliers"),
        ({"outliers": 9000}, "solver", Level.ERROR, "only 9 % of the observations"),
        ({"latency_p95_s": 0.5}, "latency", Level.WARN, "95 % within 500 ms"),
        ({"latency_p95_s": 5.0}, "latency", Level.ERROR, "95 % within 5000 ms"),
        ({"correction_held": True, "correction_m": 4.0}, "map", Level.WARN, "4.00 m, 0.000 rad is held back"),
        ({"memory_mb": 3000.0}, "memory", Level.WARN, "3000 MB"),
        ({"memory_mb": 9000.0}, "memory", Level.ERROR, "9000 MB"),
    ],
)
def test_levels(changes: dict[str, Any], subject: str, level: Level, words: str) -> None:
    found = findings(**changes)
    assert (found[subject].level, words in "; ".join(found[subject].words)) == (level, True), found[subject]
    assert {name for name, finding in found.items() if finding.level is not Level.OK} <= {subject}


def test_no_limit_on_silence_is_never_stale() -> None:
    config = Config().with_values({"node.silence_s": 0})
    found = diagnose(dataclasses.replace(HEALTHY, silence_s=1e6), config)
    assert {finding.level for finding in found} == {Level.OK}


def test_an_error_threshold_below_the_warning_is_obeyed() -> None:
    config = Config(diagnostics=DiagnosticsConfig(memory_warn_mb=1000.0, memory_error_mb=100.0))
    memory = {finding.subject: finding for finding in diagnose(HEALTHY, config)}["memory"]
    assert memory.level is Level.ERROR


def test_every_status_carries_the_full_name_of_the_node() -> None:
    message = diagnostics_message(ROSBAGS_FACTORY, diagnose(HEALTHY, Config()), "/car/ba_node", 5)
    assert [status.name for status in message.status][:2] == ["/car/ba_node: inputs", "/car/ba_node: queue"]
    assert {status.hardware_id for status in message.status} == {"/car/ba_node"}
    assert {(status.level, status.message) for status in message.status} == {(b"\x00", "ok")}
    assert message.header.stamp.nanosec == 5
