# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import matplotlib.image
import numpy as np
import pytest

from ba_node.estimate import Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.plot import Comparison, draw, ground_axes
from ba_node.synthetic import SyntheticOptions, generate

if TYPE_CHECKING:
    from pathlib import Path


def comparison(cloud: int = 300) -> Comparison:
    data = generate(SyntheticOptions(keyframes=12, landmarks=300, tracks=40))
    return Comparison(data.odometry, data.truth, data.truth, data.landmarks[:cloud])


@pytest.mark.parametrize("cloud", [0, 300])
def test_writes_a_picture_with_something_on_it(tmp_path: Path, cloud: int) -> None:
    draw(tmp_path / "a.png", comparison(cloud))
    image = matplotlib.image.imread(tmp_path / "a.png")
    assert image.shape[0] > 400
    assert image.shape[1] > 800
    assert (image[..., :3] < 0.9).any(axis=2).mean() > 0.01


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        draw(tmp_path / name, comparison())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_nothing_is_written_when_there_is_no_common_time(tmp_path: Path) -> None:
    c = comparison()
    assert c.truth is not None
    late = Poses(c.truth.keyframe_id, c.truth.stamp_ns + 10**12, c.truth.position, c.truth.orientation)
    with pytest.raises(EvaluationError, match="0 of 12 poses"):
        draw(tmp_path / "a.png", Comparison(c.before, c.after, late, np.empty((0, 3))))
    assert not (tmp_path / "a.png").exists()


def test_matplotlib_is_imported_only_to_draw() -> None:
    code = "import sys, ba_node.evaluation.plot; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_from_above_is_across_the_axis_along_which_nothing_goes() -> None:
    way = np.linspace(0.0, 9.0, 20)
    still = np.zeros(20)
    assert ground_axes(np.stack([way, still, 2.0 * way], axis=1)) == (0, 2)
    assert ground_axes(np.stack([still, way, still], axis=1)) == (0, 1)
    assert ground_axes(np.empty((0, 3))) == (0, 1)


def test_a_picture_without_a_reference_shows_what_was_moved(tmp_path: Path) -> None:
    c = comparison()
    draw(tmp_path / "a.png", Comparison(c.before, c.after, None, c.cloud))
    assert matplotlib.image.imread(tmp_path / "a.png").shape[1] > 800
