# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the units that lengths in metres are mistaken for."""

from __future__ import annotations

_UNITS = (
    (1000.0, "in millimetres"),
    (100.0, "in centimetres"),
    (10.0, "in decimetres"),
    (5000.0, "in units of 0.2 mm"),
    (256.0, "in units of 1/256 m"),
    (0.001, "in kilometres"),
    (3.2808, "in feet"),
)


def unit_of(factor: float) -> str:
    """Return the unit in which lengths are ``factor`` times those in metres; empty if none is near."""
    return next((name for value, name in _UNITS if 0.75 < factor / value < 1.33), "")
