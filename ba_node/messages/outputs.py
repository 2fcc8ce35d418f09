# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn an estimate into the messages that are published after a solve."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import IntArray
from ba_node.config import OutputConfig
from ba_node.estimate import Cloud, Estimate, Refinement, World
from ba_node.measurements import GlobalFix
from ba_node.messages.cdr import cloud_message, path_message, pose_messages, refined_message
from ba_node.messages.conversion import input_message
from ba_node.messages.factory import MessageFactory, float32, header_message, pose_message
from ba_node.messages.report import Report, report_message
from ba_node.messages.topics import OUTPUT_TYPES

# One point as it is published and as it is written to a file: five little-endian words.
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rms_px", "<f4"), ("views", "<u4")])


def output_messages(
    factory: MessageFactory, estimate: Estimate, config: OutputConfig, wanted: Container[str] = OUTPUT_TYPES
) -> list[tuple[str, str, Any]]:
    """Return what a node publishes after a solve; of a failed or skipped one the report only, unless the map is empty.

    Only topics that are ``wanted`` are built.

    Returns:
        (topic below the node's name, type, message) in the order to publish; one pose for each refined keyframe.
        All but the report and the world are bytes, serialised already (``cdr.py``).
    """
    out = pose_outputs(estimate.refinement, wanted)
    if "report" in wanted:
        out.append(("report", report_message(factory, Report(estimate.report), estimate.stamp_ns, estimate.frame_id)))
    if estimate.world is not None and estimate.report.status.usable:
        out += [(name, message) for name, message in _world(factory, estimate, estimate.world) if name in wanted]
    if estimate.replaces_map:
        if "path" in wanted:
            poses = estimate.trajectory[-config.path_max_poses :]
            out.append(("path", path_message(poses, estimate.stamp_ns, estimate.frame_id)))
        if "points" in wanted:
            out.append(("points", _points(estimate, config.points_max)))
    return [(topic, OUTPUT_TYPES[topic], message) for topic, message in out]


def point_records(cloud: Cloud, limit: int | None = None) -> NDArray[np.void]:
    """Return the points as ``POINT_DTYPE`` records, thinned evenly to at most ``limit``."""
    n = len(cloud)
    rows: IntArray | slice = slice(None)
    if limit is not None and n > limit:
        rows = np.arange(limit) * n // limit
        n = limit
    words = np.empty((n, 5), "<f4")
    words[:, :3] = float32(cloud.position[rows])
    words[:, 3] = cloud.rms_px[rows]
    words.view("<u4")[:, 4] = cloud.views[rows]
    return words.view(POINT_DTYPE)[:, 0]


def pose_outputs(refinement: Refinement, wanted: Container[str] = OUTPUT_TYPES) -> list[tuple[str, Any]]:
    """Return those of the messages, (topic, message), that tell the poses of a solve; none if it was not taken."""
    poses, out = refinement.poses, list[tuple[str, Any]]()
    if poses is not None and "refined_keyframes" in wanted:
        where = refinement.stamp_ns, refinement.frame_id, refinement.session_id
        out.append(("refined_keyframes", refined_message(poses, *where)))
    if poses is not None and "pose" in wanted:
        out += [("pose", pose) for pose in pose_messages(poses, refinement.frame_id)]
    return out


def _world(factory: MessageFactory, estimate: Estimate, world: World) -> Iterator[tuple[str, Any]]:
    """Yield where the map lies in the world, and where that begins on the earth."""
    header = header_message(factory, estimate.stamp_ns, world.frame_id)
    pose = pose_message(factory, world.position, world.orientation)
    yield "map_in_world", factory.make(OUTPUT_TYPES["map_in_world"], header=header, pose=pose)
    if world.geodetic is not None:
        fix = GlobalFix(estimate.stamp_ns, world.frame_id, world.geodetic, np.zeros(9), is_fix=True)
        yield "world_origin", input_message(factory, fix)[1]


def _points(estimate: Estimate, limit: int) -> bytes:
    records = point_records(estimate.cloud, limit)
    dense = all(bool(np.isfinite(records[name]).all()) for name in "xyz")
    return cloud_message(records, estimate.stamp_ns, estimate.frame_id, dense=dense)
