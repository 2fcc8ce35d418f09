# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Trackers that take the ids of lost tracks again: the points are kept apart, and it is said."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.evaluation.metrics import absolute_error
from ba_node.measurements import FeatureTracks, Measurement
from experiments.synthetic import SyntheticData, SyntheticOptions, generate


def with_slots(data: SyntheticData, slots: int) -> Iterator[Measurement]:
    """Yield a recording as of a tracker whose ids are slots: a lost track's is free again at once."""
    slot_of: dict[int, int] = {}
    free = list(range(slots))
    for _, _, measurement in data.timeline():
        if not isinstance(measurement, FeatureTracks):
            yield measurement
            continue
        now = measurement.track_id.tolist()
        if measurement.camera_index == 0:
            free = [slot_of.pop(key) for key in sorted(slot_of.keys() - set(now))] + free
            for key in sorted(set(now) - slot_of.keys()):
                slot_of[key] = free.pop()
        yield dataclasses.replace(measurement, track_id=np.array([slot_of[key] for key in now], np.uint64))


def replayed(measurements: Iterator[Measurement]) -> Backend:
    backend = Backend(Config())
    for measurement in measurements:
        if backend.completes(measurement):
            backend.solve()
        backend.add(measurement)
    backend.flush(final=True)
    while backend.ready:
        backend.solve()
    return backend


@pytest.mark.slow
@pytest.mark.parametrize("baseline_m", [0.12, 0.0])
def test_slots_do_no_harm_and_are_named(baseline_m: float) -> None:
    options = SyntheticOptions(
        keyframes=40, length_m=35.0, baseline_m=baseline_m, tracks=150, outlier_share=0.02, reobserve=False, path="line"
    )
    data = generate(options)
    backend = replayed(with_slots(data, 300))
    kind = "se3" if baseline_m else "sim3"
    before = absolute_error(data.odometry, data.truth, kind).translation.rmse  # type: ignore[arg-type]
    after = absolute_error(backend.estimate().trajectory, data.truth, kind).translation.rmse  # type: ignore[arg-type]
    assert after < 0.3 * before, f"{before:.3f} -> {after:.3f} m"
    assert backend.scene.log.notices["ids_reused"] > 100
    assert "give every track an id of its own" in backend.scene.log.warnings["ids_reused"]


@pytest.mark.slow
@pytest.mark.parametrize("baseline_m", [0.12, 0.0])
def test_ids_that_are_not_reused_are_left_alone(baseline_m: float) -> None:
    data = generate(SyntheticOptions(keyframes=40, length_m=35.0, baseline_m=baseline_m, outlier_share=0.2))
    backend = replayed(measurement for _, _, measurement in data.timeline())
    assert backend.scene.log.notices["ids_reused"] <= 2
    assert "ids_reused" not in backend.scene.log.warnings


@pytest.mark.slow
@pytest.mark.parametrize("outlier_share", [0.05, 0.1])
def test_a_mismatch_near_an_end_of_a_long_track_is_no_other_point(outlier_share: float) -> None:
    """The views behind it fit the point; they were parted from it, and ids said to be used again."""
    options = SyntheticOptions(
        seed=89, keyframes=45, length_m=10.0, baseline_m=0.0, path="line", landmarks=1500, track_loss=0.02,
        outlier_share=outlier_share, drift_rotation_deg=0.3, drift_translation=0.01,
    )  # fmt: skip
    backend = replayed(one for _, _, one in generate(options).timeline())
    assert "ids_reused" not in backend.scene.log.warnings
    assert backend.scene.log.notices.get("ids_reused", 0) <= 2
