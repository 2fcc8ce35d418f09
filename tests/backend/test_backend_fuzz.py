# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Random streams, good and bad: nothing raises, nothing becomes NaN, nothing that is known is lost."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from experiments.synthetic import SyntheticOptions, generate

if TYPE_CHECKING:
    from ba_node.estimate import Estimate

SETTINGS = {"solver.max_iterations": 3, "window.max_keyframes": 3, "scene.max_pending": 5, "scene.max_landmarks": 100}


@functools.cache
def good_stream(seed: int) -> tuple[Measurement, ...]:
    options = SyntheticOptions(
        keyframes=6, landmarks=300, tracks=25, length_m=10.0, path="line", ids="random64", seed=seed, guesses=True
    )
    return tuple(measurement for _, _, measurement in generate(options).timeline())


numbers = st.floats(0, 640) | st.sampled_from([np.nan, 1e8, -5.0])


@st.composite
def streams(draw: st.DrawFn) -> list[Measurement]:
    """Draw a good stream with some messages left out, repeated, moved, or spoiled."""
    out = [m for m in good_stream(draw(st.integers(0, 3))) if draw(st.integers(0, 9))]
    for _ in range(draw(st.integers(0, 6)) if out else 0):
        i, j = draw(st.integers(0, len(out) - 1)), draw(st.integers(0, len(out)))
        out.insert(j, spoiled(draw, out[i]))
    return out


def spoiled(draw: st.DrawFn, m: Measurement) -> Measurement:
    if isinstance(m, CameraRig):
        return dataclasses.replace(m, intrinsics=m.intrinsics * draw(st.sampled_from([1.0, 0.0, np.nan, 2.0])))
    session = draw(st.sampled_from([0, 0, 0, 1]))
    if isinstance(m, Keyframe):
        position = np.array([draw(numbers), 0.0, 1.0])
        stamp = m.stamp_ns + draw(st.integers(-(10**9), 10**9))
        return dataclasses.replace(m, session_id=session, position=position, stamp_ns=stamp)
    if isinstance(m, FeatureTracks):
        uv = m.uv.copy()
        uv[:: draw(st.integers(1, 3))] = draw(numbers)
        depth = np.full(len(uv), draw(numbers))
        camera = draw(st.integers(0, 3))
        return dataclasses.replace(m, session_id=session, camera_index=camera, uv=uv, depth_m=depth)
    assert isinstance(m, LandmarkGuesses)
    return dataclasses.replace(m, session_id=session, position=m.position * draw(numbers))


# Shrinking a stream takes minutes, and the last lines of a failure tell as much.
@pytest.mark.slow
@settings(max_examples=40, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(streams())
def test_no_stream_breaks_the_back_end(stream: list[Measurement]) -> None:
    backend = Backend(Config().with_values(SETTINGS))
    for measurement in stream:
        if backend.completes(measurement):
            check(backend.solve())
        known = {int(k) for k in backend.scene.keyframes.keyframe_id}
        scene = backend.scene
        backend.add(measurement)
        assert backend.scene is not scene or known <= {int(k) for k in scene.keyframes.keyframe_id}
        assert len(backend.scene.pending) <= 5
        assert len(backend.scene.landmarks) <= 100
    backend.flush(final=True)
    while backend.ready:
        check(backend.solve())


def check(estimate: Estimate | None) -> None:
    assert estimate is not None
    for poses in (estimate.refined, estimate.trajectory):
        assert np.isfinite(poses.position).all()
        np.testing.assert_allclose(np.linalg.norm(poses.orientation, axis=1), 1.0, atol=1e-9)
    assert np.isfinite(estimate.cloud.position).all()
    assert np.isfinite([estimate.report.rms_px_before, estimate.report.rms_px_after]).all()
