# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np
import pytest

from ba_node.estimate import Estimate
from ba_node.io.ply import write_ply
from tests.ply import read_ply


def test_layout_byte_by_byte(tmp_path: Path, estimate: Estimate) -> None:
    path = tmp_path / "c.ply"
    write_ply(path, estimate.cloud, "map")
    head, _, body = path.read_bytes().partition(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment frame map",
        "element vertex 100",
        "property double x",
        "property double y",
        "property double z",
        "property float rms_px",
        "property uint views",
    ]
    assert len(body) == 100 * 32
    x, y, z, rms, views = struct.unpack_from("<dddfI", body, 32 * 7)
    assert [x, y, z] == estimate.cloud.position[7].tolist()
    assert (rms, views) == (float(estimate.cloud.rms_px[7]), int(estimate.cloud.views[7]))


@pytest.mark.parametrize("frame", ["map", "", "two words", "line\nend_header\nbreak", "caf\u00e9 \\ \u5730\u56fe"])
def test_any_frame_survives(tmp_path: Path, estimate: Estimate, frame: str) -> None:
    path = tmp_path / "c.ply"
    write_ply(path, estimate.cloud, frame)
    points, found = read_ply(path)
    assert found == frame
    np.testing.assert_array_equal(points["views"], estimate.cloud.views)
    np.testing.assert_array_equal(points["z"], estimate.cloud.position[:, 2])


def test_coordinates_of_a_country_keep_their_digits(tmp_path: Path, estimate: Estimate) -> None:
    """A float32 has steps of 0.5 m at 5 412 345 m."""
    site = np.array([512_345.678, 5_412_345.678, 345.0])
    cloud = dataclasses.replace(estimate.cloud, position=estimate.cloud.position + site)
    write_ply(tmp_path / "c.ply", cloud, "map")
    points, _ = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(np.column_stack([points[axis] for axis in "xyz"]), cloud.position)
