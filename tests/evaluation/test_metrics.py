# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ba_node.estimate import Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import absolute_error, associate

EPOCH_NS = 1_700_000_000_000_000_000


def poses(position: object, seconds: object = None, rotation: Rotation | None = None) -> Poses:
    p = np.asarray(position, dtype=float)
    n = len(p)
    offsets = np.arange(n) if seconds is None else np.asarray(seconds, dtype=float)
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)) if rotation is None else rotation.as_quat().reshape(n, 4)
    stamps = EPOCH_NS + np.round(offsets * 1e9).astype(np.int64)
    return Poses(np.arange(n, dtype=np.uint64), stamps, p, quaternion)


SQUARE = [[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]


def test_numbers_worked_out_by_hand() -> None:
    off = np.array(SQUARE) + np.array([[0, 0, 0], [3, 4, 0], [0, 0, 1], [0, 2, 0]])
    error = absolute_error(poses(off), poses(SQUARE), "none")
    np.testing.assert_allclose(error.translation_m, [0.0, 5.0, 1.0, 2.0])
    summary = error.translation
    assert summary.count == 4
    assert summary.mean == pytest.approx(2.0)
    assert summary.median == pytest.approx(1.5)
    assert summary.max == pytest.approx(5.0)
    assert summary.rmse == pytest.approx(np.sqrt(30 / 4))
    assert summary.std == pytest.approx(np.sqrt(30 / 4 - 4))
    assert summary.sse == pytest.approx(30.0)
    assert summary.min == 0.0
    assert set(vars(summary)) == {"rmse", "mean", "median", "max", "std", "count", "min", "sse"}


def test_rotation_error_is_the_angle_between_the_poses() -> None:
    angles = np.array([0.0, 10.0, 90.0, 180.0])
    turned = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0]), degrees=True)
    error = absolute_error(poses(SQUARE, rotation=turned), poses(SQUARE), "se3")
    np.testing.assert_allclose(error.rotation_deg, angles, atol=1e-6)
    assert error.rotation.max == pytest.approx(180.0)


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_a_trajectory_in_another_frame_has_no_error_after_alignment(kind: str) -> None:
    rng = np.random.default_rng(0)
    scale = 1.0 if kind == "se3" else 0.3
    frame = Rotation.from_rotvec([0.5, 1.0, -2.0])
    truth_rotation = Rotation.random(30, random_state=rng)
    truth = poses(rng.normal(size=(30, 3)) * 5.0, rotation=truth_rotation)
    moved = poses(scale * frame.apply(truth.position) + [1.0, -7.0, 3.0], rotation=frame * truth_rotation)
    error = absolute_error(moved, truth, kind)  # type: ignore[arg-type]
    assert error.translation.max < 1e-9
    assert error.rotation.max < 1e-5
    assert error.alignment.scale == pytest.approx(1.0 / scale)


def test_only_poses_with_a_partner_count() -> None:
    estimate = poses([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], seconds=[0.0, 1.004, 2.5])
    truth = poses([[0.0, 0, 0], [1, 0, 3], [2, 0, 0]], seconds=[0.0, 1.0, 2.0])
    error = absolute_error(estimate, truth, "none", max_difference_s=0.01)
    np.testing.assert_allclose(error.translation_m, [0.0, 3.0])
    assert error.translation.count == 2


def test_association_is_mutual_and_exact_in_ns() -> None:
    base = EPOCH_NS
    estimate = np.array([base + 7, base + 2_000_000_001, base + 3], dtype=np.int64)
    reference = np.array([base + 2_000_000_000, base + 5, base + 900_000_000], dtype=np.int64)
    rows, partners = associate(estimate, reference, 0.01)
    # 7 and 3 are as near to 5: the first row gets it.
    np.testing.assert_array_equal(rows, [0, 1])
    np.testing.assert_array_equal(partners, [1, 0])
    rows, _ = associate(estimate, reference, 0.0)
    assert len(rows) == 0


@given(
    st.lists(st.integers(-(10**9), 10**9), max_size=30),
    st.lists(st.integers(-(10**9), 10**9), max_size=30),
    st.floats(0.0, 0.3),
)
def test_association_against_all_pairs(ours: list[int], theirs: list[int], limit: float) -> None:
    rows, partners = associate(np.array(ours, dtype=np.int64), np.array(theirs, dtype=np.int64), limit)
    assert len(set(rows.tolist())) == len(rows)
    assert len({theirs[j] for j in partners}) == len(partners)
    for i, j in zip(rows, partners, strict=True):
        gap = abs(ours[i] - theirs[j])
        assert gap == min(abs(ours[i] - t) for t in theirs)
        assert gap <= round(limit * 1e9)
    unpaired = set(range(len(ours))) - set(rows.tolist())
    taken = {theirs[j] for j in partners}
    for i in unpaired:
        gap = min((abs(ours[i] - t) for t in theirs), default=2**62)
        near = {t for t in theirs if abs(ours[i] - t) == gap}
        assert gap > round(limit * 1e9) or near & taken


def test_no_partner_is_an_error_that_names_the_spans() -> None:
    late = poses(SQUARE, seconds=[100, 101, 102, 103])
    with pytest.raises(EvaluationError, match=r"0 of 4 poses .* 1700000100\.000000000 to 1700000103\.000000000 s"):
        absolute_error(late, poses(SQUARE))


def test_too_few_partners_are_an_error_that_names_their_number() -> None:
    with pytest.raises(EvaluationError, match="2 of 4 poses have a partner; 2 points cannot be aligned"):
        absolute_error(poses(SQUARE), poses(SQUARE, seconds=[0.0, 1.0, 50.0, 60.0]))


def test_an_empty_trajectory_is_an_error() -> None:
    with pytest.raises(EvaluationError, match="the estimate is empty"):
        absolute_error(poses(np.empty((0, 3))), poses(SQUARE))
