# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective
from ba_node.io.bal import to_problem
from ba_node.io.bundler import is_bundler, read_bundler, write_bundler
from ba_node.io.model import ModelError, from_bal, to_bal

# Two cameras that look along -z at three points; the second image could not be placed.
SCENE = """# Bundle file v0.3
3 2
500 -0.1 0.01
1 0 0
0 1 0
0 0 1
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
0 0 0
400 0 0
1 0 0
0 1 0
0 0 1
-1 0 0
1 2 -10
10 20 30
2 0 5 48.0 97.0 2 7 1.0 80.5
-1 0 -8
255 255 255
1 2 8 -100.0 0.25
"""


def test_a_scene_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "bundle.out"
    path.write_text(SCENE)
    assert is_bundler(path)
    scene = read_bundler(path)
    assert (scene.n_cameras, scene.camera.tolist(), scene.key.tolist()) == (3, [0, 2], [5, 7, 8])
    assert scene.colour.tolist() == [[10, 20, 30], [255, 255, 255]]
    # By hand, the formula of the format: p = -(x, y) / z, u = f (1 + k1 |p|^2 + k2 |p|^4) p.
    p = np.array([0.1, 0.2])
    scale = 1.0 - 0.1 * 0.05 + 0.01 * 0.05**2
    residuals = np.concatenate([500.0 * scale * p - [48.0, 97.0], 400.0 * np.array([0.0, 0.2]) - [1.0, 80.5]])
    residuals = np.concatenate([residuals, 400.0 * np.array([-0.25, 0.0]) - [-100.0, 0.25]])
    problem = to_problem(scene.bal)
    expected = 0.5 * float(residuals @ residuals)
    assert Objective(problem, SolverOptions()).value(problem.start) == pytest.approx(expected, rel=1e-12)
    # The same with the principal point apart, z forward and y down.
    model = from_bal(scene.bal)
    assert Objective(model.problem(), SolverOptions()).value(model.problem().start) == pytest.approx(
        expected, rel=1e-12
    )
    back = to_bal(model)
    np.testing.assert_allclose(back.cameras, scene.bal.cameras, atol=1e-12)
    np.testing.assert_allclose(back.observations, scene.bal.observations)


def test_a_scene_reads_back_as_it_was(tmp_path: Path) -> None:
    path, again = tmp_path / "bundle.out", tmp_path / "again.out"
    path.write_text(SCENE)
    write_bundler(again, read_bundler(path))
    first, second = (read_bundler(name) for name in (path, again))
    for name in ("cameras", "points", "camera_index", "point_index", "observations"):
        np.testing.assert_array_equal(getattr(first.bal, name), getattr(second.bal, name), name)
    np.testing.assert_array_equal(first.key, second.key)
    numbers = [float(word) for word in again.read_text().split("\n", 1)[1].split()]
    assert numbers == [float(word) for word in SCENE.split("\n", 1)[1].split()]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# Bundle file v0.3", "3 2", "expected '# Bundle file v0.3' in the first line"),
        ("3 2\n500", "3 2\nfive", "something is not a number"),
        ("1 2 8 -100.0 0.25\n", "", "truncated or damaged at point 1 of 2"),
        ("2 0 5", "2 9 5", "a view of point 0 is of camera 9, of 3"),
        ("500 -0.1 0.01\n1 0 0", "500 -0.1 0.01\n1 0.5 0", "camera 0: its rotation is off an orthonormal one by"),
        ("-1 0 -8", "-1 nan -8", "expected a finite one"),
        ("3 2\n", "3000 2\n", "truncated: 3000 cameras make"),
    ],
)
def test_damaged_scenes_are_named(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.out"
    path.write_text(SCENE.replace(old, new, 1))
    with pytest.raises(ModelError) as error:
        read_bundler(path)
    assert words in str(error.value)


def test_cameras_that_bal_has_no_place_for_are_named(tmp_path: Path) -> None:
    path = tmp_path / "bundle.out"
    path.write_text(SCENE)
    model = from_bal(read_bundler(path).bal)
    model.cameras.params[1, 6] = 0.01
    with pytest.raises(ModelError, match=r"camera 1 \(RADIAL\): BAL and Bundler have cameras of f, k1 and k2 alone"):
        to_bal(model)
