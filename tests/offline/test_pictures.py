# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import matplotlib.image
import pytest

from ba_node.estimate import Poses
from ba_node.offline.figures import trajectory_figures
from ba_node.offline.pictures import draw_trajectory
from ba_node.offline.run_folder import Comparison
from experiments.synthetic import SyntheticOptions, generate

if TYPE_CHECKING:
    from pathlib import Path


def comparison(cloud: int = 300) -> Comparison:
    data = generate(SyntheticOptions(keyframes=12, landmarks=300, tracks=40))
    return Comparison("here", data.odometry, data.truth, data.truth, data.landmarks[:cloud], "se3")


@pytest.mark.slow
@pytest.mark.parametrize("cloud", [0, 300])
def test_writes_a_picture_with_something_on_it(tmp_path: Path, cloud: int) -> None:
    draw_trajectory(tmp_path / "a.png", comparison(cloud))
    image = matplotlib.image.imread(tmp_path / "a.png")
    assert image.shape[0] > 400
    assert image.shape[1] > 800
    assert (image[..., :3] < 0.9).any(axis=2).mean() > 0.01


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        draw_trajectory(tmp_path / name, comparison())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_the_error_is_told_where_there_is_a_reference_of_the_same_time() -> None:
    c = comparison()
    assert c.truth is not None
    figures, title = trajectory_figures(c)
    assert [figure.key for figure in figures] == ["above", "error"]
    assert title.endswith("m before, 0.000 m after adjustment")
    assert trajectory_figures(replace(c, before=None))[1].endswith(" 0.000 m")
    late = Poses(c.truth.keyframe_id, c.truth.stamp_ns + 10**12, c.truth.position, c.truth.orientation)
    for truth in (None, late):
        figures, title = trajectory_figures(replace(c, truth=truth))
        assert title == "Trajectory before and after adjustment"
        assert [trace["name"] for trace in figures[1].data] == ["moved"]


@pytest.mark.slow
def test_matplotlib_is_imported_only_to_draw() -> None:
    code = "import sys, ba_node.offline.pictures; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
