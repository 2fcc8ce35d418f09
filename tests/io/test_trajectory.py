# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ba_node.estimate import Estimate, Poses
from ba_node.io.reference import read_poses
from ba_node.io.trajectory import TrajectoryError, format_stamp, parse_stamp, read_tum, write_tum


@given(st.integers(-(2**63), 2**63 - 1))
def test_stamps_survive_exactly(stamp_ns: int) -> None:
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


def test_stamps_are_seconds_with_nine_decimals() -> None:
    expected = {0: "0.000000000", 1: "0.000000001", -1: "-0.000000001", -1_500_000_000: "-1.500000000"}
    expected |= {1_700_000_000_123_456_789: "1700000000.123456789", 2**63 - 1: "9223372036.854775807"}
    assert {stamp: format_stamp(stamp) for stamp in expected} == expected


def test_stamps_of_other_programs_are_read() -> None:
    cases = {"1.5": 1_500_000_000, "1403636579.7635555842": 1_403_636_579_763_555_584, "3": 3_000_000_000}
    cases |= {"1.403636579763555584e+09": 1_403_636_579_763_555_584, "-0.25": -250_000_000}
    assert {text: parse_stamp(text) for text in cases} == cases


def test_what_was_written_is_read_exactly(tmp_path: Path, estimate: Estimate) -> None:
    path = tmp_path / "t.tum"
    write_tum(path, estimate.trajectory)
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamp_ns, estimate.trajectory.stamp_ns)
    np.testing.assert_array_equal(back.position, estimate.trajectory.position)
    np.testing.assert_array_equal(back.orientation, estimate.trajectory.orientation)
    again = tmp_path / "again.tum"
    write_tum(again, back)
    assert again.read_bytes() == path.read_bytes()


def test_form_of_a_line(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    position, orientation = np.array([[1.0, -2.5, 1e-7]]), np.array([[0.0, 0.0, 0.0, 1.0]])
    write_tum(path, Poses(np.array([7], dtype=np.uint64), np.array([1_000_000_001]), position, orientation))
    assert path.read_text() == "# stamp x y z qx qy qz qw\n1.000000001 1.0 -2.5 1e-07 0.0 0.0 0.0 1.0\n"
    assert read_tum(path).keyframe_id.tolist() == [0], "the format has no ids"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1.0 1 2 3 0 0 0", r":3: 7 values: expected 8"),
        ("1.0 1 2 3 0 0 0 1 9", r":3: 9 values: expected 8"),
        ("1 0 0 0 0 1 0 0 0 0 1 0", r":3: 12 values: expected 8 .*; those of KITTI have no stamps"),
        ("x 1 2 3 0 0 0 1", r":3: stamp 'x' is not a number"),
        ("nan 1 2 3 0 0 0 1", r":3: stamp 'nan': expected finite seconds"),
        ("inf 1 2 3 0 0 0 1", r":3: stamp 'inf': expected finite seconds"),
        ("1e10 1 2 3 0 0 0 1", r":3: stamp '1e10': expected finite seconds, within int64"),
        ("1e99999 1 2 3 0 0 0 1", r":3: stamp '1e99999': expected finite seconds, within int64"),
        ("1.0 1 b 3 0 0 0 1", r":3: y = 'b' is not a number"),
        ("1.0 1 2 nan 0 0 0 1", r":3: z = nan: expected a finite number"),
        ("1.0 1 2 3 0 0 0 0", r":3: the quaternion is zero"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# stamps\n0.5 1 2 3 0 0 0 1\n{line}\n")
    with pytest.raises(TrajectoryError, match=words):
        read_tum(path)


def test_files_without_poses_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    path.write_text("# only a comment\n\n")
    with pytest.raises(TrajectoryError, match="no pose in it"):
        read_tum(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match="not a text file"):
        read_tum(path)
    with pytest.raises(TrajectoryError, match="cannot be opened"):
        read_tum(tmp_path / "absent.tum")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 " * 12, r"1: its first three columns are no rotation: R R' is off the identity by 1"),
        ("2 0 0 0 0 2 0 0 0 0 2 0", r"R R' is off the identity by 3"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", r"mirror space \(determinant -1\)"),
        ("1 0 0 0 0 1 0 0 0 0 1", r"1: expected 12 finite numbers: the first three rows of a pose \(KITTI\)"),
        ("# nothing", r"no pose in it: expected lines with the first three rows of a pose \(KITTI\)"),
    ],
)
def test_rows_of_kitti_that_are_no_poses_are_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "poses.kitti"
    path.write_text(text + "\n")
    with pytest.raises(TrajectoryError, match=words):
        read_poses(path)
