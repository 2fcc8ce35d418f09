# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What a fault is: what it does to a recording, how much of it, and what a user must be told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.robustness.faults.recording import Recording
from experiments.synthetic.world import Path, World

Edit = Callable[[Recording, float, np.random.Generator], Recording]
Motion = Callable[[World, Path, float], tuple[World, Path]]

STEREO, MONO, RGBD = "stereo", "mono", "rgbd"
RIGS: dict[str, dict[str, Any]] = {
    STEREO: {"baseline_m": 0.12},
    MONO: {"baseline_m": 0.0},
    RGBD: {"baseline_m": 0.0, "depth_share": 0.9},
}


@dataclass(frozen=True)
class Fault:
    """One way in which a recording goes wrong."""

    about: str  # what is wrong, for tables
    edit: Edit | None = None  # what it does to the messages
    motion: Motion | None = None  # what it does to the world and the path
    amounts: tuple[float, ...] = (1.0,)  # how much of it, the usual first
    rigs: tuple[str, ...] = (STEREO, MONO)  # the rigs that can have it, the usual first
    # patterns (re, any case), each of which must be found in the messages to the user; none where the result is to be
    # as good as ever
    named: tuple[str, ...] = ()
    # exit codes of a replay that are right: 3 where there is something to look at, 2 where it may be refused
    codes: tuple[int, ...] = (0, 3)
    least: float = 1.0  # share of the keyframe messages that have to be published
    changes: Mapping[str, Any] = field(default_factory=dict)  # options of the recording that it needs
