# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check that a young map is refined as a whole as it grows, and where it is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.window import guard
from ba_node.window.merging import Merged
from ba_node.window.selection import Selection
from ba_node.window.trust import Trust
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.window.street import aligned_rms

ONE_CAMERA = {"baseline_m": 0.0}


def recording(seed: int, **changes: Any) -> SyntheticData:
    """Return a drive of 27 m whose front-end drifts."""
    options: dict[str, Any] = {
        "keyframes": 40, "length_m": 27.0, "landmarks": 1500, "tracks": 100, "noise_px": 0.5,
        "outlier_share": 0.0, "drift_rotation_deg": 0.5, "drift_translation": 0.02,
    }  # fmt: skip
    return generate(SyntheticOptions(seed=seed, **(options | changes)))


def replayed(data: SyntheticData, **values: object) -> tuple[Backend, float]:
    """Return a back-end that has seen a recording, and the error of its path, m."""
    backend = Backend(Config().with_values({"guard.check_setup": False} | values))
    last = [event for event in backend.replay(m for _, _, m in data.timeline()) if isinstance(event, Estimate)][-1]
    return backend, aligned_rms(last.trajectory.position, data.truth.position)


@pytest.mark.slow
def test_what_windows_leave_is_near_the_optimum_of_everything() -> None:
    ratios, alone = [], []
    for seed in (51, 52, 53, 54, 55):
        data = recording(seed, **ONE_CAMERA)
        backend, found_m = replayed(data)
        assert backend.map.adjustments == 3  # at 21, 27 and 34 keyframes
        without_m = replayed(data, **{"factors.adjust_m": 0.0})[1]
        best = backend.optimize()
        assert best is not None
        best_m = aligned_rms(best.trajectory.position, data.truth.position)
        ratios.append(found_m / best_m)
        alone.append(without_m / best_m)
    assert np.median(ratios) < 1.2
    assert np.median(ratios) < 0.9 * np.median(alone)


def test_a_map_within_one_window_is_left_to_it() -> None:
    assert replayed(recording(51, keyframes=20, length_m=13.0))[0].map.adjustments == 0


def test_a_replay_gives_the_same_twice() -> None:
    data = recording(51, keyframes=24, length_m=16.0, landmarks=800, tracks=60)
    first, second = (replayed(data)[0] for _ in range(2))
    assert first.map.adjustments == 1
    assert first.scene.keyframes.position.tobytes() == second.scene.keyframes.position.tobytes()


@pytest.mark.parametrize("values", [{"factors.adjust_m": 0.0}, {"window.old_keyframes": "marginalise"}])
def test_it_is_left_out_where_that_is_asked_for(values: dict[str, object]) -> None:
    data = recording(51, keyframes=24, length_m=16.0, landmarks=800, tracks=60)
    assert replayed(data, **values)[0].map.adjustments == 0


def test_one_that_is_refused_leaves_what_windows_found_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    data = recording(51, keyframes=24, length_m=16.0, landmarks=800, tracks=60)
    alone, _ = replayed(data, **{"factors.adjust_m": 0.0})
    decide = guard.decide

    def refuses(config: Config, selection: Selection, found: Merged, trust: Trust | None = None) -> guard.Verdict:
        return guard.Verdict("no") if trust is None else decide(config, selection, found, trust)

    monkeypatch.setattr(guard, "decide", refuses)
    backend, _ = replayed(data)
    assert backend.map.summary().notices == {"not_refined": 1} and not backend.map.warnings
    np.testing.assert_array_equal(backend.scene.keyframes.position, alone.scene.keyframes.position)
