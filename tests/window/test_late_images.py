# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All images are late against the stamps of odometry: the offset is recovered, or said not to be told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.core.calibration import Parameter
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from experiments.synthetic.world import Path as Motion
from experiments.synthetic.world import World
from tests.window.street import replayed

RATE, LATE_S = 5.0, 0.0208


def recording(late_s: float, *, gentle: bool, n: int = 60) -> SyntheticData:
    """Return keyframes with the poses at their stamps, and images that were taken so much later."""
    options = SyntheticOptions(
        seed=3, keyframes=n, landmarks=1500, tracks=80, length_m=40.0, baseline_m=0.2, outlier_share=0.02, path="line",
        drift_rotation_deg=0.2, drift_translation=0.005, keyframe_rate_hz=RATE, noise_px=0.3,
    )  # fmt: skip

    def at(late_s: float) -> SyntheticData:
        t = np.arange(n) / RATE + late_s

        def drive(world: World, _: Motion) -> tuple[World, Motion]:
            # Curves of seconds; or a body that nods with every other keyframe.
            nod = np.zeros(n) if gentle else 0.05 * np.sin(0.9 * np.pi * RATE * t)
            turn = np.stack([0.05 * np.sin(1.3 * t), 0.06 * np.cos(0.9 * t) + nod, 0.35 * np.sin(1.1 * t)], axis=1)
            along = 3.0 * t + 1.2 * np.sin(0.9 * t)
            position = np.stack([along, 1.5 * np.sin(0.7 * t), 1.2 + 0.2 * np.sin(0.8 * t)], axis=1)
            return world, Motion(position, geometry.so3_exp(turn), along + 2.0)

        return generate(options, drive)

    there, seen = at(0.0), at(late_s)
    return dataclasses.replace(seen, keyframes=there.keyframes, truth=there.truth)


def clock_of(data: SyntheticData) -> Parameter:
    """Return what a solve of everything tells of the clock of the first camera."""
    chosen = {"guard.enabled": False, "guard.check_setup": False, "calibration.time_offset": "refined"}
    backend, _ = replayed(data, lambda *_: (), **chosen)
    assert backend.optimize() is not None
    found = backend.map.calibration
    assert found is not None
    (clock,) = [one for one in found.parameters if one.name == "time_offset" and one.camera == 0]
    assert clock.told or any("not told by the data, left as given: time_offset" in line for line in found.lines())
    return clock


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [LATE_S, 0.0])
def test_on_a_gentle_way_the_offset_is_recovered_to_a_fifth(late_s: float) -> None:
    clock = clock_of(recording(late_s, gentle=True))
    assert clock.told
    assert clock.change == pytest.approx(late_s, abs=LATE_S / 5.0), f"{1e3 * clock.change:.1f} ms"
    assert abs(clock.change - late_s) < 2.5 * clock.sigma < 0.02


@pytest.mark.slow
def test_where_keyframes_do_not_tell_how_velocities_change_it_is_held() -> None:
    clock = clock_of(recording(LATE_S, gentle=False, n=40))
    assert not clock.told and clock.change == 0.0
