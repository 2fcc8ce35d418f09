# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes that leave the window: fixed, dropped, or made a prior of."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node import window
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core.marginal import MarginalPrior
from ba_node.estimate import Estimate, Extras
from ba_node.window.old_keyframes import Memory
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

N = 6


def slid(old_keyframes: str, n: int = N, **changes: object) -> tuple[Backend, SyntheticData, Estimate]:
    """Return a back-end after a recording in which a window of n slides over sixteen keyframes."""
    fields = {
        "seed": 3, "keyframes": 16, "landmarks": 600, "tracks": 50, "length_m": 12.0, "path": "line", "baseline_m": 0.2,
        "outlier_share": 0.0, "drift_rotation_deg": 0.3, "drift_translation": 0.01,
    }  # fmt: skip
    data = generate(SyntheticOptions(**{**fields, **changes}))  # type: ignore[arg-type]
    chosen = {"window.max_keyframes": n, "window.old_keyframes": old_keyframes, "guard.check_setup": False}
    chosen["factors.adjust_m"] = 0.0  # windows alone: only with `fix` is a map refined as it grows
    backend = Backend(Config().with_values(chosen))
    backend.extras = Extras(covariance=True)
    last = [event for event in backend.replay(m for _, _, m in data.timeline()) if isinstance(event, Estimate)][-1]
    return backend, data, last


def error_m(backend: Backend, data: SyntheticData) -> float:
    found = backend.estimate().trajectory.position
    return float(np.sqrt(np.mean(np.sum((found - data.truth.position) ** 2, axis=1))))


def selected(backend: Backend) -> window.Selection:
    found = window.select(backend.scene, backend.config)
    assert isinstance(found, window.Selection), found
    return found


def test_marginalised_keyframes_leave_a_prior_and_take_no_part() -> None:
    backend, data, last = slid("marginalise")
    selection = selected(backend)
    problem = selection.problem
    assert np.count_nonzero(~problem.fixed) == N
    (prior,) = [kind for kind in problem.factors if isinstance(kind, MarginalPrior)]
    assert 1 <= prior.keyframes.shape[1] < N
    memory = backend.scene.memory
    assert isinstance(memory, Memory) and len(memory.tracks) > 20
    assert not np.isin(selection.keyframe_id, memory.left).any(), "what has just left takes no part"
    assert not memory.used(backend.scene, selection.rows).any(), "an observation counts once"
    drift = np.linalg.norm([k.position for k in data.keyframes] - data.truth.position, axis=1)
    assert error_m(backend, data) < 0.5 * np.sqrt(np.mean(drift**2))
    # Against the first keyframe of the map, and not against the window's: it is as large as the error.
    assert last.covariance is not None
    off = last.refined.position[-1] - data.truth.position[-1]
    assert 0.05 < off @ np.linalg.solve(last.covariance[-1][:3, :3], off) < 13.0


@pytest.mark.slow
def test_the_choice_decides_what_is_fixed() -> None:
    shares = {}
    for choice in ("fix", "drop"):
        backend, _, _ = slid(choice)
        selection = selected(backend)
        shares[choice] = int(np.count_nonzero(selection.problem.fixed))
        assert not any(isinstance(kind, MarginalPrior) for kind in selection.problem.factors)
    assert shares["drop"] == 1 and shares["fix"] > 1


@pytest.mark.parametrize("moved_by", ["a solve of everything", "another parameter"])
def test_the_prior_is_given_up_where_the_map_has_moved(moved_by: str) -> None:
    backend, _, _ = slid("marginalise")
    if moved_by == "another parameter":
        backend.configure(backend.config.with_values({"window.old_keyframes": "fix"}))
    else:
        assert backend.optimize() is not None
    selection = selected(backend)
    assert not any(isinstance(kind, MarginalPrior) for kind in selection.problem.factors)
    assert selection.problem.fixed.any()


@pytest.mark.slow
def test_the_memory_does_not_grow() -> None:
    """A long way in which nothing is seen again: what is kept is what the window may still see."""
    backend, _, _ = slid("marginalise", keyframes=40, length_m=30.0, landmarks=1200)
    memory = backend.scene.memory
    assert isinstance(memory, Memory)
    assert len(memory.left) <= N and len(memory.tracks) < 400 and len(memory.keyframe_id) < N


@pytest.mark.slow
@pytest.mark.parametrize(("baseline_m", "most"), [(0.2, 1.5), pytest.param(0.0, 2.2, marks=pytest.mark.slow)])
def test_tracks_that_last_do_not_unglue_the_window(baseline_m: float, most: float) -> None:
    """Every keyframe that leaves sees tracks that go on alone: what it told of them is not lost."""
    fields: dict[str, object] = {"path": "line", "track_loss": 0.0, "landmarks": 800, "tracks": 60, "keyframes": 50}
    fields |= {"length_m": 40.0, "baseline_m": baseline_m, "seed": 4, "reobserve": False}
    errors = {choice: error_m(*slid(choice, 10, **fields)[:2]) for choice in ("fix", "marginalise")}
    assert errors["marginalise"] < most * errors["fix"], errors


@pytest.mark.slow
def test_one_camera_drifts_no_more_and_tells_how_much() -> None:
    """A straight road of 30 m: the error is that of fixed keyframes or less, and the covariance is as large as it."""
    fields: dict[str, object] = {"path": "line", "baseline_m": 0.0, "keyframes": 40, "length_m": 30.0}
    fields |= {"landmarks": 800, "tracks": 60}
    squared: dict[str, list[float]] = {"fix": [], "marginalise": []}
    nees = []
    for seed in (3, 4, 5, 6):
        for choice, found in squared.items():
            backend, data, last = slid(choice, 10, seed=seed, **fields)
            found.append(error_m(backend, data) ** 2)
        assert last.covariance is not None
        off = last.refined.position[-1] - data.truth.position[-1]
        nees.append(float(off @ np.linalg.solve(last.covariance[-1][:3, :3], off)))
    assert np.mean(squared["marginalise"]) < 1.1 * np.mean(squared["fix"]), squared
    # Of twelve numbers the mean square lies between 0.37 and 1.94 in 95 of 100 cases; here by three.
    assert 0.8 < np.mean(nees) < 6.0, nees
