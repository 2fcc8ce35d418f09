# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A keyframe costs the same however many there were before: counted in memory that is asked for, not in time."""

from __future__ import annotations

import itertools
import sys
import tracemalloc

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from experiments.benchmarks import long_life
from experiments.benchmarks.long_life import Corridor, rig

SMALL = {"window.max_keyframes": 6, "window.max_fixed_keyframes": 4}


@pytest.mark.slow
@pytest.mark.parametrize("still", [False, True])
def test_a_keyframe_asks_for_no_more_memory_in_a_large_map(still: bool) -> None:
    backend = Backend(Config().with_values(SMALL))
    backend.add(rig())
    peaks: dict[int, list[int]] = {100: [], 1000: []}
    for count, frame in enumerate(itertools.islice(Corridor(40, still=still).frames(), 1000), start=1):
        size = next((size for size in peaks if size - 20 < count <= size), None)
        if size is not None:
            tracemalloc.start()
        for measurement in frame:
            backend.add(measurement)
        if any(size - 40 < count <= size for size in peaks):
            estimate = backend.solve()
            assert estimate is not None
            assert len(estimate.trajectory) == count
        else:
            backend.scene.keyframes.solved[-1] = backend.scene.keyframes.refined[-1] = True
        if size is not None:
            assert backend.report.status.usable, backend.report.reason
            peaks[size].append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    few, many = (float(np.median(values)) for values in peaks.values())
    assert many < 1.1 * few + 30e3, f"{few:.0f} bytes at 100 keyframes, {many:.0f} at 1000"


def test_the_table_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--keyframes", "12", "--at", "6", "--span", "3", "--tracks", "40", "--optimize"]
    monkeypatch.setattr(sys, "argv", ["long_life", *arguments])
    assert long_life.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:4]] == ["6", "12"]
    assert lines[-1].startswith("copied in ")
