# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Problems that are made part by part are the same whatever the number of parts, and as published ones are."""

from __future__ import annotations

import numpy as np
import pytest

from ba_node.core.objective import rms_px, squared_errors
from experiments.benchmarks.scale import measure
from experiments.benchmarks.streams import PUBLISHED, Stream, named

KINDS = ("street", "city", "loop")


@pytest.mark.parametrize("kind", KINDS)
def test_parts_are_those_of_the_whole(kind: str) -> None:
    stream = Stream(kind, 120, 9000, 5.0)
    whole, parts = stream.part(0, 1), [stream.part(rank, 3) for rank in range(3)]
    np.testing.assert_array_equal(np.concatenate([p.observations.uv for p in parts]), whole.observations.uv)
    np.testing.assert_array_equal(np.concatenate([p.start.points for p in parts]), whole.start.points)
    for part in parts:
        np.testing.assert_array_equal(part.start.rotation, whole.start.rotation)
        part.check()


@pytest.mark.parametrize("kind", KINDS)
def test_points_lie_before_cameras_that_see_them(kind: str) -> None:
    """A noise of 0.2 m of points and 0.05 m of cameras at 8 m and more is some 20 px; nobody looks backwards."""
    problem = Stream(kind, 600, 9000, 5.0).part(0, 1)
    rms = rms_px(squared_errors(problem, problem.start))
    assert 5.0 < rms < 60.0, rms
    assert 4.0 < len(problem.observations) / problem.n_points < 5.2


@pytest.mark.parametrize("name", ["ladybug-1723"])
def test_published_sizes(name: str) -> None:
    """Within a tenth of 678 718 observations."""
    problem = PUBLISHED[name].part(0, 1)
    assert (problem.n_keyframes, problem.n_points) == (1723, 156_502)
    assert len(problem.observations) == pytest.approx(678_718, rel=0.1)


def test_a_name_that_is_none() -> None:
    with pytest.raises(ValueError, match="street:N"):
        named("street:x")


def test_what_is_measured() -> None:
    found = measure("city:64", 3, {})
    assert found is not None
    assert found["ranks"] == 1 and found["iterations"] == 3
    assert found["objective"][1] < 0.02 * found["objective"][0], found["objective"]
    assert found["peak_mb"] > 10.0 and found["sums"] > 3
