# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of a front-end that are more precise than stated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.window import precision
from experiments.synthetic import SyntheticOptions, generate


def replayed(
    drift_rotation_deg: float, drift_translation: float, keyframes: int, **more: Any
) -> tuple[Backend, float, float]:
    """Return a back-end after noisy images of a straight road, and the errors of input and result, rms, m."""
    of: dict[str, Any] = {"seed": 3, "path": "line", "noise_px": 1.0, "tracks": 60} | more
    data = generate(
        SyntheticOptions(
            keyframes=keyframes, length_m=0.5 * keyframes, landmarks=25 * keyframes,
            reobserve=False, drift_rotation_deg=drift_rotation_deg, drift_translation=drift_translation,
            **of,
        )
    )  # fmt: skip
    backend = Backend(Config())
    for _ in backend.replay(m for _, _, m in data.timeline()):
        pass
    given = np.array([keyframe.position for keyframe in data.keyframes])
    found = backend.estimate().trajectory.position
    errors = [float(np.sqrt(np.mean(np.sum((x - data.truth.position) ** 2, axis=1)))) for x in (given, found)]
    return backend, errors[0], errors[1]


def test_a_front_end_ten_times_as_precise_as_images_is_not_spoilt() -> None:
    backend, given, found = replayed(0.01, 0.002, 80)
    assert max(backend.scene.step_shares) <= 0.25, backend.scene.step_shares
    assert found < 1.05 * given, (given, found)
    grown = 4  # at 21, 30, 42 and 59 keyframes
    # And once more at the end.
    assert backend.report.adjustments - grown in (2, 3), "the keyframes of before it was known follow"
    assert not backend.report.warnings


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        {"baseline_m": 0.0, "path": "loop", "seed": 1},
        {"baseline_m": 0.0, "path": "loop", "seed": 5},
        {"baseline_m": 0.0, "path": "line", "seed": 4},
        {"baseline_m": 0.0, "depth_share": 1.0, "depth_noise": 0.02, "seed": 4},
    ],
    ids=["mono", "mono_loop", "mono_line", "rgbd"],
)
def test_so_it_is_where_images_tell_lengths_badly(more: dict[str, Any]) -> None:
    backend, given, found = replayed(0.01, 0.002, 80, **more)
    assert max(backend.scene.step_shares) <= 0.25, backend.scene.step_shares
    assert found < 1.06 * given, (given, found)


@pytest.mark.parametrize(
    "more",
    [
        {"seed": 3},
        {"seed": 9, "path": "loop"},
        {"seed": 4, "baseline_m": 0.0},
        {"seed": 6, "baseline_m": 0.0, "depth_share": 1.0, "depth_noise": 0.02},
        # Its keyframes see less than tells of each how good steps are.
        {"seed": 5, "tracks": 40},
    ],
    ids=["line", "loop", "mono", "rgbd", "few_tracks"],
)
def test_a_map_that_ends_after_a_window_or_two_is_asked_as_a_whole(more: dict[str, Any]) -> None:
    backend, given, found = replayed(0.01, 0.002, 28, **more)
    assert found < 1.1 * given, (given, found)
    assert min(backend.scene.step_shares) <= 0.5, backend.scene.step_shares
    assert not backend.report.warnings


@pytest.mark.slow
def test_steps_that_are_precise_in_their_turns_alone_count_for_these() -> None:
    backend, given, found = replayed(0.01, 0.02, 60, baseline_m=0.0, path="loop", seed=12, noise_px=1.5)
    assert backend.scene.step_shares[0] < 0.1 and backend.scene.step_shares[1] == 1.0, backend.scene.step_shares
    assert found < 0.6 * given, (given, found)


@pytest.mark.slow
def test_steps_as_stated_or_worse_stay_as_they_are() -> None:
    backend, given, found = replayed(0.3, 0.02, 50)
    assert backend.scene.step_shares == (1.0, 1.0)
    assert backend.report.adjustments == 3, "as the map had grown to 21, 30 and 42 keyframes"
    assert found < given


@pytest.mark.slow
def test_windows_go_on_while_it_is_asked_what_steps_are_worth(monkeypatch: pytest.MonkeyPatch) -> None:
    """One study at a time; what it finds counts once it is taken in, and once."""
    monkeypatch.setattr(precision.Precision, "ask_all", lambda *_: False)
    data = generate(SyntheticOptions(seed=3, keyframes=45, length_m=22.0, landmarks=1000, tracks=60, path="line"))
    backend, handed = Backend(Config()), list[precision.Study]()
    backend.elsewhere = lambda work: handed.append(work) if isinstance(work, precision.Study) else None
    estimates = [one for one in backend.replay(m for _, _, m in data.timeline()) if isinstance(one, Estimate)]
    assert len(estimates) == 45 and len(handed) == 1
    known = backend.map.precision
    assert known.windows == known.seen == 0
    handed[0].run()
    assert known.windows == 0
    for _ in range(2):
        assert backend.take_work(handed[0]) is None
        assert (known.windows, known.seen) == (1, 20)


@pytest.mark.parametrize("share", [1.0, 0.25, 1.0 / 32.0])
def test_the_likeliest_share_is_that_of_the_noise(share: float) -> None:
    rng = np.random.default_rng(1)
    root = 0.03 * share * rng.normal(size=(600, 600))
    error = (root @ rng.normal(size=600) + share * rng.normal(size=600)).reshape(200, 3)
    covariances = (root @ root.T).reshape(200, 3, 200, 3)
    likelihood, fit = precision._told(error, covariances, np.ones(200))
    best = int(np.argmax(likelihood))
    assert precision._SHARES[best] == share
    assert abs(fit[best] - 1.0) < 0.2, fit


def test_errors_that_images_share_tell_nothing() -> None:
    """Too good or too bad an agreement with images, or images that are far more precise than stated steps."""
    sure = np.tile(10.0 * np.arange(7), (2, 1))
    for fit, coarse, taken in ((1.0, 1.0, True), (0.2, 1.0, False), (2.0, 1.0, False), (1.0, 0.05, False)):
        fits = np.array([np.full(7, 2.0), np.full(7, 2.0 * fit)])
        known = precision.Precision(sure, fits, np.array([2.0, 2.0 * coarse]), 2, 30)
        assert (known.shares()[1] != 1.0) == taken, (fit, coarse)


def test_the_less_images_tell_the_less_has_to_be_known() -> None:
    """Of lengths that images tell badly nothing is lost by a share that is too small."""
    little = np.tile(np.minimum(1.0, np.arange(7)), (2, 1))
    known = precision.Precision(little, np.full((2, 7), 2.0), np.array([2.0, 6.0]), 2, 30)
    rotation, translation = known.shares()
    assert rotation == 1.0 and translation < 0.2, (rotation, translation)
