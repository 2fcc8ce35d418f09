# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn an estimate into the messages that are published after a solve."""

from __future__ import annotations

from collections.abc import Container
from typing import TYPE_CHECKING, Any

import numpy as np

from ba_node.estimate import Cloud, Estimate, Poses, SolveReport
from ba_node.messages.factory import MessageFactory, float32, header_message, pose_message

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ba_node.config import OutputConfig

OUTPUT_TYPES = {
    "refined_keyframes": "ba_msgs/msg/RefinedKeyframes",
    "pose": "geometry_msgs/msg/PoseStamped",
    "path": "nav_msgs/msg/Path",
    "points": "sensor_msgs/msg/PointCloud2",
    "report": "ba_msgs/msg/SolverReport",
}
# One point as it is published and as it is written to a file: little endian, 20 bytes.
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rms_px", "<f4"), ("views", "<u4")])

# Values of sensor_msgs/PointField.
_POINT_FIELD = {"<f4": 7, "<u4": 6}


class _Everything(Container[str]):
    def __contains__(self, item: object) -> bool:
        return True


def output_messages(
    factory: MessageFactory, estimate: Estimate, config: OutputConfig, wanted: Container[str] = _Everything()
) -> list[tuple[str, str, Any]]:
    """Return what a node publishes after a solve; of a failed or skipped one the report only.

    Args:
        factory: makes the messages.
        estimate: what the solve gave.
        config: caps on the length of the path and the number of points.
        wanted: topics that someone listens to; the others are not built.

    Returns:
        (topic below the node's name, type, message) in the order to publish; one pose for each refined keyframe.
    """
    out: list[tuple[str, Any]] = []
    if estimate.report.status.usable:
        if "refined_keyframes" in wanted:
            out.append(("refined_keyframes", _refined(factory, estimate)))
        if "pose" in wanted:
            out += [("pose", pose) for pose in _stamped(factory, estimate.refined, estimate.frame_id)]
        if "path" in wanted:
            out.append(("path", _path(factory, estimate, config.path_max_poses)))
        if "points" in wanted:
            out.append(("points", _points(factory, estimate, config.points_max)))
    if "report" in wanted:
        out.append(("report", _report(factory, estimate)))
    return [(topic, OUTPUT_TYPES[topic], message) for topic, message in out]


def point_records(cloud: Cloud, limit: int | None = None) -> NDArray[np.void]:
    """Return the points as ``POINT_DTYPE`` records, thinned evenly to at most ``limit``."""
    n = len(cloud)
    rows: NDArray[np.intp] | slice = slice(None)
    if limit is not None and n > limit:
        rows = np.arange(limit) * n // limit
        n = limit
    records = np.empty(n, dtype=POINT_DTYPE)
    for column, name in enumerate("xyz"):
        records[name] = float32(cloud.position[rows, column])
    records["rms_px"] = cloud.rms_px[rows]
    records["views"] = cloud.views[rows]
    return records


def _stamped(factory: MessageFactory, poses: Poses, frame_id: str) -> list[Any]:
    return [
        factory.make(
            OUTPUT_TYPES["pose"],
            header=header_message(factory, stamp, frame_id),
            pose=pose_message(factory, position, orientation),
        )
        for stamp, position, orientation in zip(poses.stamp_ns.tolist(), poses.position, poses.orientation, strict=True)
    ]


def _refined(factory: MessageFactory, estimate: Estimate) -> Any:
    poses = estimate.refined
    return factory.make(
        OUTPUT_TYPES["refined_keyframes"],
        header=header_message(factory, estimate.stamp_ns, estimate.frame_id),
        session_id=estimate.report.session_id,
        keyframe_id=factory.array(poses.keyframe_id),
        stamp_ns=factory.array(poses.stamp_ns),
        position=factory.array(poses.position.reshape(-1)),
        orientation=factory.array(poses.orientation.reshape(-1)),
    )


def _path(factory: MessageFactory, estimate: Estimate, limit: int) -> Any:
    return factory.make(
        OUTPUT_TYPES["path"],
        header=header_message(factory, estimate.stamp_ns, estimate.frame_id),
        poses=_stamped(factory, estimate.trajectory[-limit:], estimate.frame_id),
    )


def _points(factory: MessageFactory, estimate: Estimate, limit: int) -> Any:
    records = point_records(estimate.cloud, limit)
    size = POINT_DTYPE.itemsize
    assert POINT_DTYPE.fields is not None
    fields = [
        factory.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_POINT_FIELD[kind.str], count=1)
        for name, (kind, offset, *_) in POINT_DTYPE.fields.items()
    ]
    return factory.make(
        OUTPUT_TYPES["points"],
        header=header_message(factory, estimate.stamp_ns, estimate.frame_id),
        height=1,
        width=len(records),
        fields=fields,
        is_bigendian=False,
        point_step=size,
        row_step=size * len(records),
        data=factory.array(records.view(np.uint8)),
        is_dense=all(bool(np.isfinite(records[name]).all()) for name in "xyz"),
    )


def _report(factory: MessageFactory, estimate: Estimate) -> Any:
    report = estimate.report
    fields = {name: getattr(report, name) for name in SolveReport.__dataclass_fields__ if name != "rejected"}
    reasons = sorted(report.rejected)
    return factory.make(
        OUTPUT_TYPES["report"],
        header=header_message(factory, estimate.stamp_ns, estimate.frame_id),
        rejected_reason=reasons,
        rejected_count=factory.array(np.array([report.rejected[reason] for reason in reasons], dtype=np.uint64)),
        **(fields | {"status": int(report.status)}),
    )
