# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The back-end: keyframes in, refined estimates out. What stands above it uses this face and nothing below."""

from ba_node.backend.backend import Backend, Work
from ba_node.backend.clock import ClockWatch
from ba_node.backend.current_map import CurrentMap, can_examine
from ba_node.backend.summary import MapEnded, MapSummary
from ba_node.backend.worse import is_worse
from ba_node.check.diagnosis import Diagnosis, Row
from ba_node.check.watch import Check
from ba_node.core.calibration import Calibration
from ba_node.scene.ingest import why_refused
from ba_node.scene.map_content import MapContent, MapError
from ba_node.window.adjustment import Adjustment
from ba_node.window.full import Optimization

__all__ = [
    "Adjustment",
    "Backend",
    "Calibration",
    "Check",
    "ClockWatch",
    "CurrentMap",
    "Diagnosis",
    "MapContent",
    "MapEnded",
    "MapError",
    "MapSummary",
    "Optimization",
    "Row",
    "Work",
    "can_examine",
    "is_worse",
    "why_refused",
]
