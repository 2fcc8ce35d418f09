# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make a recording with a fault and its truth: ``recording = spoiled("camera_turned", amount=2.0, seed=3)``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.robustness.faults.catalogue import FAULTS
from experiments.robustness.faults.fault import RIGS, STEREO
from experiments.robustness.faults.recording import Recording
from experiments.synthetic.generate import generate
from experiments.synthetic.options import SyntheticOptions
from experiments.synthetic.world import Path, World

SOUND = "sound"
# A short drive with odometry that is good, so that harm shows, and yet worse than what the tracks tell.
_BASE: dict[str, Any] = {
    "keyframes": 40,
    "landmarks": 2500,
    "path": "line",
    "length_m": 20.0,
    "tracks": 150,
    "outlier_share": 0.01,
    "drift_rotation_deg": 0.3,
    "drift_translation": 0.02,
}


def spoiled_by(
    faults: Sequence[tuple[str, float | None]], rig: str | None = None, seed: int = 0, **changes: Any
) -> Recording:
    """Return a recording with several faults at once, see :func:`spoiled`; each with its amount, None for the usual."""
    options = dict(_BASE)
    known = [(name, FAULTS[name], FAULTS[name].amounts[0] if amount is None else amount) for name, amount in faults]
    for _, fault, _ in known:
        options |= fault.changes
    options |= RIGS[rig or (known[0][1].rigs[0] if known else STEREO)] | changes

    def moved(world: World, path: Path) -> tuple[World, Path]:
        for _, fault, much in known:
            if fault.motion is not None:
                world, path = fault.motion(world, path, much)
        return world, path

    data = generate(SyntheticOptions(**options, seed=seed), moved)
    recording = Recording(data, tuple(data.timeline()))
    for name, fault, much in known:
        if fault.edit is not None:
            recording = fault.edit(recording, much, np.random.default_rng([seed, *name.encode()]))
    return recording


def spoiled(name: str, rig: str | None = None, amount: float | None = None, seed: int = 0, **changes: Any) -> Recording:
    """Return a recording with a fault. The same arguments give the same numbers.

    Args:
        name: one of FAULTS, or ``sound`` for none.
        rig: one of RIGS; None for the usual one of the fault.
        amount: how much of the fault; None for the usual.
        seed: of world, noise and fault.
        changes: SyntheticOptions other than those of a short drive with good odometry.

    Raises:
        KeyError: no such fault or rig.
        ConfigError: an option out of range.
    """
    return spoiled_by([] if name == SOUND else [(name, amount)], rig, seed, **changes)
