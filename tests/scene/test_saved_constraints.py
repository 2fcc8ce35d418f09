# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is known beside pixels is saved with a map, comes back bit for bit, and counts in the next full adjustment."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.backend.archive import unpack
from ba_node.core import geometry
from ba_node.measurements import (
    GravityDirection,
    Keyframe,
    LandmarkPriors,
    Measurement,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.scene import saved_constraints
from ba_node.scene.constraints import Absolute, Constraints
from ba_node.scene.map_content import MapContent, MapError
from ba_node.scene.rejections import RejectionLog
from experiments.synthetic import SyntheticOptions, generate
from tests.window.street import replayed

TURNED = geometry.quaternion_from_matrix(geometry.so3_exp(np.array([0.1, -0.2, 0.3])))
IDS = np.array([2**64 - 1, 7], np.uint64)


def everything() -> Constraints:
    """Return one of each kind, and two that were compared with the map already."""
    known, log = Constraints(), RejectionLog()
    six = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]).ravel()
    for first, second in ((1, 2), (2, 3), (3, 2**64 - 1)):
        known.add_relative(RelativePose(0, first, second, second > 3, np.array([1.0, 2.0, 3.0]), TURNED, six), log)
    known.unchecked.remove((1, 2))
    known.refused.add((2, 3))
    known.add_step(5, six, log)
    known.add_gravity(GravityDirection(0, 5, np.array([0.0, 0.6, -0.8]), 0.1), log)
    known.add_landmarks(LandmarkPriors(0, "site", IDS, np.ones((2, 3)), np.tile(0.1 * np.eye(3), (2, 1, 1))), log)
    known.add_pose(PosePrior(10**18, "site", np.ones(3), TURNED, six), log)
    known._insert(Absolute(10**18 - 5, np.zeros(3), None, np.zeros((3, 3)), of_antenna=True))
    known._insert(Absolute(10**18 + 5, np.zeros(3), None, np.eye(3), of_antenna=True))
    known.add_merge(TrackMerge(0, IDS, IDS[::-1].copy() - np.array([1, 1], np.uint64)), log)
    known.renamed, known.adjusted_at, known.steps_precise = {5: 9}, 12, True
    assert not log.rejected
    return known


def plain(value: Any) -> Any:
    """Return something with its arrays as bytes, to be compared."""
    if isinstance(value, np.ndarray):
        return value.shape, str(value.dtype), value.tobytes()
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(one) for one in value]
    return plain(vars(value)) if hasattr(value, "__dict__") else value


def saved() -> MapContent:
    content = saved_constraints.take(everything())
    content.facts.update(json.loads(json.dumps(content.facts)))
    return content


def test_all_of_it_comes_back() -> None:
    loaded = Constraints()
    saved_constraints.restore(saved(), loaded)
    assert plain(vars(loaded)) == plain(vars(everything()))
    empty = Constraints()
    saved_constraints.restore(saved_constraints.take(empty), empty)
    assert plain(vars(empty)) == plain(vars(Constraints()))
    older = saved()
    saved_constraints.restore(MapContent({}, {"world": older.facts["world"]}), empty)
    assert empty.world_frame == "site" and not empty.relative, "a map of an older version has no arrays of these"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("relative_poses/rotation", 0.5, "relative_poses/rotation of row 0 .*expected a rotation"),
        ("relative_poses/position", np.nan, "relative_poses/position of row 0 .*finite numbers"),
        ("relative_poses/to", 1, "relative_poses: keyframes 1 and 1, expected two, once"),
        ("steps/covariance", 0.0, "steps/covariance of row 0: lowest eigenvalue 0"),
        ("gravity/down", 2.0, "gravity/down of row 0 .*expected a unit vector"),
        ("gravity/sigma_rad", 0.0, "gravity/sigma_rad of row 0 = 0.0: expected a number > 0"),
        ("landmark_priors/track_id", 7, "landmark_priors/track_id = 7 occurs more than once"),
        ("landmark_priors/covariance", -1.0, "landmark_priors/covariance of row 0"),
        ("absolute/stamp_ns", 2 * 10**18, "absolute/stamp_ns: expected the oldest first"),
        ("absolute/rotation", np.inf, "absolute/rotation of row 0"),
    ],
)
def test_what_cannot_be_is_refused(name: str, value: float, message: str) -> None:
    content = copy.deepcopy(saved())
    content.arrays[name][0] = value
    with pytest.raises(MapError, match=message):
        saved_constraints.restore(content, Constraints())


def test_a_part_that_is_missing_is_refused() -> None:
    content = saved()
    del content.arrays["merges/same_as"]
    with pytest.raises(MapError, match="merges/same_as is missing"):
        saved_constraints.restore(content, Constraints())


def test_a_full_adjustment_of_a_loaded_map_uses_them() -> None:
    """Wheels 4 % longer than tracks with metric depth have it: with the map loaded the map still grows by them."""
    data = generate(SyntheticOptions(seed=4, keyframes=14, landmarks=500, tracks=40, length_m=14.0, path="line"))
    rotation, position = geometry.matrix_from_quaternion(data.truth.orientation), data.truth.position

    def wheels(k: int, keyframe: Keyframe) -> Iterator[Measurement]:
        if k:
            turn, move = geometry.compose(*geometry.inverse(rotation[k - 1], position[k - 1]), rotation[k], position[k])
            pose = 1.04 * move, geometry.quaternion_from_matrix(turn)
            before = int(data.truth.keyframe_id[k - 1])
            yield RelativePose(0, before, keyframe.keyframe_id, False, *pose, 1e-8 * np.eye(6).ravel())

    backend, _ = replayed(data, wheels, **{"guard.enabled": False, "guard.check_setup": False})
    content = backend.snapshot()

    def adjusted(content: MapContent) -> np.ndarray:
        loaded = Backend(backend.config)
        loaded.take_over(unpack(content, backend.config.scene))
        estimate = loaded.optimize()
        assert estimate is not None
        return np.array(estimate.trajectory.position)

    expected = backend.optimize()
    assert expected is not None
    np.testing.assert_array_equal(adjusted(content), expected.trajectory.position)
    without = {
        name: array[:0] if name.startswith("relative_poses/") else array for name, array in content.arrays.items()
    }
    lengths = [
        np.linalg.norm(np.diff(one, axis=0), axis=1).sum()
        for one in (adjusted(content), adjusted(MapContent(without, content.facts)))
    ]
    assert lengths[0] > 1.02 * lengths[1], lengths
