# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import array
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages.conversion import input_message, measurement_from_message
from ba_node.messages.outputs import output_messages
from ba_node.messages.topics import INPUT_TYPES
from ba_node.ros.message_factory import RclpyFactory, message_class

FACTORY = RclpyFactory()


@pytest.mark.parametrize("dtype", ["u1", "i4", "u4", "i8", "u8", "f4", "f8"])
@pytest.mark.parametrize("n", [0, 1, 1000])
def test_array_keeps_every_bit(dtype: str, n: int) -> None:
    values = np.random.default_rng(n).integers(0, 256, n * np.dtype(dtype).itemsize, np.uint8).view(dtype)
    made = FACTORY.array(values)
    assert isinstance(made, array.array)
    assert made.tobytes() == values.tobytes()


def test_array_takes_what_is_not_contiguous() -> None:
    assert FACTORY.array(np.arange(10, dtype=np.uint64)[::3]).tolist() == [0, 3, 6, 9]


@pytest.mark.parametrize("name", ["no_such_msgs/msg/Thing", "std_msgs/msg/NoSuchThing", "Header", ""])
def test_an_unknown_type_is_named(name: str) -> None:
    with pytest.raises(LookupError, match=f"message type '{name}'"):
        message_class(name)


def test_inputs_survive_the_wire(
    keyframe: Keyframe,
    tracks: FeatureTracks,
    guesses: LandmarkGuesses,
    rig: CameraRig,
    beside_pixels: list[Measurement],
) -> None:
    sent: dict[str, tuple[Measurement, Any]] = {
        "keyframes": (keyframe, input_message(FACTORY, keyframe)[1]),
        "feature_tracks": (tracks, input_message(FACTORY, tracks, 5, "left_optical")[1]),
        "landmark_guesses": (guesses, input_message(FACTORY, guesses, 5, "map")[1]),
        "camera_rig": (rig, input_message(FACTORY, rig, 5)[1]),
    }
    sent |= {topic: (one, message) for one in beside_pixels for topic, message in [input_message(FACTORY, one)]}
    for topic, (measurement, message) in sent.items():
        kind = INPUT_TYPES[topic]
        received = deserialize_message(serialize_message(message), message_class(kind))
        got = measurement_from_message(kind, received)
        for name, value in vars(measurement).items():
            np.testing.assert_equal(getattr(got, name), value, err_msg=f"{topic}.{name}")


def test_outputs_survive_the_wire(estimate: Estimate) -> None:
    messages = output_messages(FACTORY, estimate, Config().output)
    received = {
        topic: deserialize_message(
            message if isinstance(message, bytes) else serialize_message(message), message_class(kind)
        )
        for topic, kind, message in messages
    }
    assert sorted(received) == ["path", "points", "pose", "refined_keyframes", "report"]
    np.testing.assert_array_equal(np.asarray(received["refined_keyframes"].keyframe_id), estimate.refined.keyframe_id)
    np.testing.assert_array_equal(
        np.asarray(received["refined_keyframes"].position).reshape(-1, 3), estimate.refined.position
    )
    assert len(received["path"].poses) == len(estimate.trajectory)
    points = np.frombuffer(bytes(received["points"].data), "<f4").reshape(-1, 5)
    np.testing.assert_allclose(points[:, :3], estimate.cloud.position, rtol=1e-6)
    report = received["report"]
    assert dict(zip(report.rejected_reason, report.rejected_count, strict=True)) == dict(estimate.report.rejected)
    assert tuple(report.warnings) == estimate.report.warnings
    for name in set(vars(estimate.report)) - {"rejected", "warnings"}:
        assert getattr(report, name) == getattr(estimate.report, name), name
