# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write measurements as the recording that a front-end would have left, and read the truth that comes with one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ba_node.backend import Backend, ClockWatch
from ba_node.config import FramesConfig
from ba_node.estimate import Poses
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.bag_writer import BagWriter
from ba_node.io.reference import TRUTH_TOPIC, poses_on
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, Keyframe, Measurement
from ba_node.messages.conversion import InputMessages
from ba_node.messages.factory import header_message, pose_message
from ba_node.messages.topics import INPUT_TYPES, TF_STATIC
from ba_node.offline.rig import static_tree

TRUTH_TYPE = "geometry_msgs/msg/PoseStamped"


def record(
    path: Path | str,
    timeline: Iterable[tuple[str, int, Measurement]],
    truth: Poses | None = None,
    camera_info: Mapping[str, Any] = MappingProxyType({}),
    *,
    as_it_came: bool = False,
) -> int:
    """Write a recording; return the number of messages.

    The timeline has topic (one of INPUT_TYPES), stamp in ns, measurement; the rig before the tracks. True poses are
    written beside the keyframes of their id. ``camera_info`` are fields of every CameraInfo that differ from what the
    rig says, those of ``roi`` as a mapping. Players and readers go by stamps, or ``as_it_came`` by the order of the
    timeline: where stamps go back, times of recording go on.

    Raises:
        BagError: a message cannot be written.
        ConversionError: a stamp does not fit into a message.
    """
    rows = {} if truth is None else {int(keyframe): row for row, keyframe in enumerate(truth.keyframe_id)}
    messages, count = InputMessages(ROSBAGS_FACTORY), 0
    last_ns = ahead_ns = 0  # time of recording of the last message; by how much those are ahead of stamps
    with BagWriter(path) as writer:
        for topic, stamp_ns, measurement in timeline:
            _, message = messages.of(measurement, stamp_ns)
            if as_it_came:
                ahead_ns += max(last_ns - stamp_ns - ahead_ns, 0)
            last_ns = stamp_ns + ahead_ns
            if isinstance(measurement, CameraRig):
                for info in message.cameras:
                    _set(info, camera_info)
            elif isinstance(measurement, Keyframe) and truth is not None:
                pose = _true_pose(truth, rows[measurement.keyframe_id], measurement.frame_id)
                writer.write(TRUTH_TOPIC, TRUTH_TYPE, pose, last_ns)
                count += 1
            writer.write(topic, INPUT_TYPES[topic], message, last_ns, latched=isinstance(measurement, CameraRig))
            count += 1
    return count


def arriving(
    measurements: Iterable[tuple[str, int, Measurement]], backend: Backend
) -> Iterator[tuple[str, int, Measurement]]:
    """Yield all measurements; a back-end gets to know when each was recorded, to tell where the clock was set."""
    watch = ClockWatch()
    for topic, time_ns, one in measurements:
        watch.came(backend, one, 1e-9 * time_ns)
        yield topic, time_ns, one


def placed(
    measurements: Iterator[tuple[str, int, Measurement]], reader: BagReader, frames: FramesConfig
) -> Iterator[Measurement]:
    """Yield measurements, cameras where ``frames.extrinsics`` says that they sit.

    Raises:
        BagError: /tf_static of the recording does not tell where a camera sits.
    """
    if frames.extrinsics != "tf_static":
        yield from (measurement for _, _, measurement in measurements)
        return
    tree = static_tree(reader)
    for _, _, measurement in measurements:
        if not isinstance(measurement, CameraRig) or measurement.malformed:
            yield measurement
            continue
        rig, missing = tree.place(measurement, frames.base_frame)
        if missing:
            names = ", ".join(map(repr, missing))
            raise BagError(
                f"{reader.path}: frames.extrinsics = tf_static: no way from {frames.base_frame!r} to {names} in"
                f" {TF_STATIC}: record it, or set frames.extrinsics=rig"
            )
        yield rig


def read_truth(reader: BagReader) -> Poses | None:
    """Return the true poses in a recording by time, numbered from 0; None if it has none that can be read.

    ``reader.warnings`` names what cannot be read. Of several robots the truth is that of the keyframes taken.
    """
    try:
        return _read_truth(reader)
    except BagError as error:
        reader.warnings["ground_truth"] = f"no comparison with the truth in the recording: {error}"
        return None


def _read_truth(reader: BagReader) -> Poses | None:
    topics = [
        topic for topic, kind in reader.topics.items() if kind == TRUTH_TYPE and f"/{topic}".endswith(f"/{TRUTH_TOPIC}")
    ]
    own = f"{reader.taken.get('keyframes', '').rpartition('/')[0]}/{TRUTH_TOPIC}"
    topics.sort(key=lambda topic: topic != own)
    if not topics:
        return None
    reader.check(topics[0])
    return poses_on(reader, topics[0]) or None


def _set(message: Any, fields: Mapping[str, Any]) -> None:
    for name, value in fields.items():
        if isinstance(value, Mapping):
            _set(getattr(message, name), value)
        else:
            setattr(message, name, value)


def _true_pose(truth: Poses, row: int, frame_id: str) -> object:
    return ROSBAGS_FACTORY.make(
        TRUTH_TYPE,
        header=header_message(ROSBAGS_FACTORY, int(truth.stamp_ns[row]), frame_id),
        pose=pose_message(ROSBAGS_FACTORY, truth.position[row], truth.orientation[row]),
    )
