# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Copy what is known out of a scene: poses of keyframes and points; and say which keyframes a solve had."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ba_node.core import geometry
from ba_node.estimate import Cloud, Poses

if TYPE_CHECKING:
    from ba_node.scene.scene import Scene
    from ba_node.scene.tables import IntArray
    from ba_node.window.selection import Selection


def cloud_of(scene: Scene, rows: IntArray) -> Cloud:
    """Return those of some landmarks that have a position and two views."""
    points = scene.landmarks
    rows = rows[points.has_position[rows] & (points.views[rows] >= 2)]
    return Cloud(points.track_id[rows], points.position[rows], points.rms_px[rows], points.views[rows])


def poses_of(scene: Scene, rows: IntArray) -> Poses:
    """Return the poses of some keyframes."""
    table = scene.keyframes
    return Poses(
        table.keyframe_id[rows],
        table.stamp_ns[rows],
        table.position[rows],
        geometry.quaternion_from_matrix(table.rotation[rows]),
    )


def taking_part_of(scene: Scene, selection: Selection) -> IntArray:
    """Return the keyframes of the window and of the problem, oldest first."""
    marked = np.zeros(len(scene.keyframes), bool)
    marked[selection.window] = True
    marked[selection.keyframes] = True
    return scene.order[marked[scene.order]]
