# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ba_node.config import OutputConfig
from ba_node.core import geometry
from ba_node.estimate import Estimate, WindowView
from ba_node.io.ros_types import decode
from ba_node.messages.markers import NAMESPACES, marker_array, no_markers

ADD, DELETE, DELETE_ALL, LINE_LIST = 0, 2, 3, 5
VERTICES = 16


@pytest.fixture
def seen(estimate: Estimate) -> Estimate:
    """Return an estimate of five refined keyframes, the first two held, seen by two cameras."""
    cone = np.array([[0.0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1]])
    view = WindowView(
        free=np.array([False, False, True, True, True]),
        rms_px=np.array([0.1, np.nan, 0.0, 1.0, 5.0]),
        links=np.array([[0, 1], [1, 4], [2, 3]]),
        shared=np.array([50, 10, 100]),
        frusta=np.stack([cone, cone + np.array([0.2, 0.0, 0.0])]),
    )
    return dataclasses.replace(estimate, view=view)


def drawn(estimate: Estimate, *, clear: bool = False, **config: Any) -> dict[str, Any]:
    data = marker_array(estimate, OutputConfig(**config), clear=clear)
    return {marker.ns: marker for marker in decode("visualization_msgs/msg/MarkerArray", data).markers}


def points(marker: Any) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3)


def colours(marker: Any) -> np.ndarray:
    return np.array([(c.r, c.g, c.b, c.a) for c in marker.colors]).reshape(-1, 4)


def test_one_list_of_lines_for_each_namespace(seen: Estimate) -> None:
    markers = drawn(seen)
    assert tuple(markers) == NAMESPACES
    counts = {name: len(marker.points) for name, marker in markers.items()}
    # Two cameras: the trajectory has 12 keyframes, 5 of them refined.
    assert counts == {"free": 3 * 2 * VERTICES, "fixed": 2 * 2 * VERTICES, "older": 7 * 2 * VERTICES, "links": 3 * 2}
    for marker in markers.values():
        assert (marker.id, marker.type, marker.action, marker.header.frame_id) == (0, LINE_LIST, ADD, "map")
        assert len(marker.colors) == len(marker.points)
        assert marker.scale.x > 0.0
        assert marker.pose.orientation.w == 1.0


def test_frusta_stand_where_the_cameras_are(seen: Estimate) -> None:
    assert seen.view is not None
    lines = points(drawn(seen, markers_frustum_m=0.5)["fixed"]).reshape(2, 2, 8, 2, 3)
    for k in range(2):
        rotation = geometry.matrix_from_quaternion(seen.refined.orientation[k])
        for camera in range(2):
            cone = seen.view.frusta[camera]
            corners = cone[0] + 0.5 * (cone - cone[0])
            in_map = corners @ rotation.T + seen.refined.position[k]
            ends = {tuple(np.round(end, 9)) for end in lines[k, camera].reshape(-1, 3)}
            assert ends == {tuple(np.round(corner, 9)) for corner in in_map}
            np.testing.assert_allclose(lines[k, camera, :4, 0], np.tile(in_map[0], (4, 1)), atol=1e-12)


def test_colours_tell_the_error(seen: Estimate) -> None:
    shades = colours(drawn(seen, markers_rms_px=2.0)["free"]).reshape(3, -1, 4)
    assert (shades == shades[:, :1]).all()
    np.testing.assert_allclose(shades[:, 0, :3], [[0, 1, 0], [1, 1, 0], [1, 0, 0]], atol=1e-6)


def test_links_with_more_common_points_are_brighter(seen: Estimate) -> None:
    links = drawn(seen)["links"]
    opacity = colours(links)[::2, 3]
    assert (np.diff(opacity) < 0).all(), "those with most come first"
    assert opacity[0] == 1.0
    np.testing.assert_allclose(points(links)[:2], seen.refined.position[[2, 3]])


def test_caps_keep_the_newest_and_the_strongest(seen: Estimate) -> None:
    markers = drawn(seen, markers_max_keyframes=3, markers_max_links=1)
    assert markers["older"].action == DELETE and not markers["older"].points
    assert markers["fixed"].action == DELETE
    assert len(markers["free"].points) == 3 * 2 * VERTICES
    np.testing.assert_allclose(points(markers["links"]), seen.refined.position[[2, 3]])
    assert len(drawn(seen, markers_max_keyframes=7)["older"].points) == 2 * 2 * VERTICES
    assert drawn(seen, markers_max_links=0)["links"].action == DELETE


def test_a_session_begins_with_an_empty_picture(seen: Estimate) -> None:
    data = marker_array(seen, OutputConfig(), clear=True)
    markers = decode("visualization_msgs/msg/MarkerArray", data).markers
    assert [marker.action for marker in markers] == [DELETE_ALL, ADD, ADD, ADD, ADD]
    nothing = decode("visualization_msgs/msg/MarkerArray", no_markers(seen)).markers
    assert [marker.action for marker in nothing] == [DELETE_ALL]


@pytest.mark.parametrize("frame", ["m", "map", "a/long/frame"])
def test_any_frame_name_keeps_the_numbers_aligned(seen: Estimate, frame: str) -> None:
    markers = drawn(dataclasses.replace(seen, frame_id=frame))
    assert {marker.header.frame_id for marker in markers.values()} == {frame}
    np.testing.assert_allclose(points(markers["links"])[:2], seen.refined.position[[2, 3]])
