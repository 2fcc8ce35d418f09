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
from ba_node.window import adjustment, guard
from ba_node.window.merging import Merged
from ba_node.window.precision import Precision
from ba_node.window.selection import Selection
from ba_node.window.trust import Trust
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.window.street import aligned_rms


def recording(seed: int, **changes: Any) -> SyntheticData:
    """Return a drive of 27 m with two cameras whose front-end drifts."""
    options: dict[str, Any] = {
        "keyframes": 40, "length_m": 27.0, "path": "line", "baseline_m": 0.12, "landmarks": 1500, "tracks": 100,
        "noise_px": 0.5, "outlier_share": 0.0, "drift_rotation_deg": 0.5, "drift_translation": 0.02,
    }  # fmt: skip
    return generate(SyntheticOptions(seed=seed, **(options | changes)))


def replayed(data: SyntheticData, **values: object) -> tuple[Backend, float]:
    """Return a back-end that has seen a recording, and the error of its path, m."""
    backend = Backend(Config().with_values({"guard.check_setup": False} | values))
    last = [event for event in backend.replay(m for _, _, m in data.timeline()) if isinstance(event, Estimate)][-1]
    return backend, aligned_rms(last.trajectory.position, data.truth.position)


ONE_CAMERA = {"baseline_m": 0.0, "landmarks": 2500, "tracks": 120}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "keyframes", "changes", "often"),
    [(61, 42, {}, 3), (66, 42, {}, 3), (303, 43, ONE_CAMERA, 4), (307, 43, ONE_CAMERA, 4)],
    ids=["stereo", "stereo again", "one camera", "one camera again"],
)
def test_a_map_that_has_grown_is_near_the_optimum_of_everything(
    seed: int, keyframes: int, changes: dict[str, Any], often: int
) -> None:
    data = recording(seed, keyframes=keyframes, length_m=0.667 * keyframes, **changes)
    backend, _ = replayed(data)
    assert backend.map.adjustments == often  # at 21, 30 and 42 keyframes; with one camera at 21, 27, 34 and 43
    windows, _ = replayed(data, **{"factors.adjust_m": 0.0})
    found, alone = (one.estimate().trajectory.position for one in (backend, windows))
    best = windows.optimize()
    assert best is not None
    assert aligned_rms(found, best.trajectory.position) < 0.6 * aligned_rms(alone, best.trajectory.position)


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


@pytest.mark.parametrize("changes", [{"tracks": 20}, {"drift_rotation_deg": 3.0}])
def test_it_is_left_out_where_little_is_seen_or_the_front_end_is_far_worse_than_stated(changes: dict[str, Any]) -> None:
    few = {"keyframes": 24, "length_m": 16.0, "landmarks": 800, "tracks": 60}
    assert replayed(recording(51, **few | changes))[0].map.adjustments == 0


def test_one_camera_is_left_to_its_windows_where_nothing_tells_its_scale_or_tracks_say_no(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = recording(51, keyframes=24, length_m=16.0, **ONE_CAMERA)
    assert replayed(data)[0].map.adjustments == 1
    badly_stated = {"odometry.sigma_m_per_m": 0.2}
    backend, _ = replayed(data, **badly_stated)  # ten times what it errs by, as is found at the end
    assert 0.05 < backend.scene.step_shares[1] < 0.3 and backend.map.adjustments == 1
    with monkeypatch.context() as patch:
        patch.setattr(Precision, "ask_all", lambda *_: False)
        assert replayed(data, **badly_stated)[0].map.adjustments == 0
    monkeypatch.setattr(adjustment, "_WORSE", -0.1)  # it would have to explain them better by so much
    backend, _ = replayed(data)
    assert backend.map.summary().notices == {"not_refined": 1} and not backend.map.adjustments


@pytest.mark.parametrize(("kind", "times"), [("held", 0), ("depths", 0), ("bad_stamp", 1), ("stray", 1)])
def test_maps_of_which_more_was_said_than_stamps_are_left_to_their_windows(kind: str, times: int) -> None:
    few = {"keyframes": 24, "length_m": 16.0, "landmarks": 800, "tracks": 60}
    backend = Backend(Config().with_values({"guard.check_setup": False}))
    for _ in backend.replay(m for _, _, m in recording(51, **few).timeline()):
        backend.scene.log.warn(kind, "something is odd")
    assert backend.map.adjustments == times


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
