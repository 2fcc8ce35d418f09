# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read what we write with other programs' decoders: mcap-ros2-support and the middleware's own."""

from __future__ import annotations

import array
import importlib
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from ba_node.config import OutputConfig
from ba_node.io import ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_writer import BagWriter
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.conversion import input_message, measurement_from_message
from ba_node.messages.outputs import output_messages
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES

if TYPE_CHECKING:
    from ba_node.estimate import Estimate

F = ROSBAGS_FACTORY


@pytest.fixture
def messages(
    keyframe: Keyframe, tracks: FeatureTracks, guesses: LandmarkGuesses, rig: CameraRig, estimate: Estimate
) -> list[tuple[str, str, Any]]:
    """Return one of every message: inputs and outputs."""
    inputs = {
        "camera_rig": input_message(F, rig, 5)[1],
        "keyframes": input_message(F, keyframe)[1],
        "feature_tracks": input_message(F, tracks, 5, "c")[1],
        "landmark_guesses": input_message(F, guesses, 5, "map")[1],
        "camera_info": input_message(F, rig, 5)[1].cameras[1],
    }
    out = [(name, INPUT_TYPES[name], message) for name, message in inputs.items()]
    return out + output_messages(F, estimate, OutputConfig())


def plain(value: Any) -> Any:
    """Return a message of any library as dicts and lists; NaN and infinity as words, so that they compare."""
    if isinstance(value, (np.ndarray, array.array, bytes, bytearray)):
        return plain(np.asarray(bytearray(value) if isinstance(value, bytes) else value).tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else str(value)
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.generic, int, str)):
        return value
    fields = getattr(value, "get_fields_and_field_types", None)
    names = fields() if fields else vars(value) or value.__slots__
    return {name: plain(getattr(value, name)) for name in names if name.islower() and name[0] != "_"}


def test_mcap_ros2_support_reads_the_same(tmp_path: Path, messages: list[tuple[str, str, Any]]) -> None:
    path = tmp_path / "all.mcap"
    with BagWriter(path) as bag:
        for t, (topic, type_name, message) in enumerate(messages):
            bag.write(f"/{topic}", type_name, message, t)
    with path.open("rb") as stream:
        found = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(found) == len(messages)
    for (_, channel, message, decoded), (topic, type_name, original) in zip(found, messages, strict=True):
        assert channel.topic == f"/{topic}"
        whole = ros_types.decode(type_name, original) if isinstance(original, bytes) else original
        assert plain(decoded) == plain(whole), topic
        assert message.log_time == message.publish_time


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(
    ids=st.lists(st.integers(0, 2**64 - 1), max_size=4),
    values=st.lists(st.floats(width=32), min_size=4, max_size=4),
    keyframe_id=st.integers(0, 2**64 - 1),
    session_id=st.integers(0, 2**32 - 1),
)
def test_extremes_survive_cdr(ids: list[int], values: list[float], keyframe_id: int, session_id: int) -> None:
    n = len(ids)
    column = np.array(values)[:n]
    tracks = FeatureTracks(
        session_id, keyframe_id, 0, np.array(ids, np.uint64), np.stack([column, -column], axis=1), column, -column
    )
    kind = INPUT_TYPES["feature_tracks"]
    data = ros_types.encode(kind, input_message(F, tracks, -1, "c")[1])
    back = measurement_from_message(kind, ros_types.decode(kind, data))
    other = DecoderFactory().decoder_for(
        "cdr",
        SimpleNamespace(id=1, name=kind, encoding="ros2msg", data=ros_types.schema_text(kind).encode()),
    )
    assert other is not None
    for found in (back, measurement_from_message(kind, other(data))):
        assert isinstance(found, FeatureTracks)
        assert (found.session_id, found.keyframe_id) == (session_id, keyframe_id)
        assert found.track_id.tolist() == ids
        np.testing.assert_array_equal(found.uv, tracks.uv)
        np.testing.assert_array_equal(found.sigma_px, tracks.sigma_px)
        np.testing.assert_array_equal(found.depth_m, tracks.depth_m)


def ros_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    module = pytest.importorskip(f"{package}.msg", reason="needs the message packages of ROS 2", exc_type=ImportError)
    return getattr(module, name)


def test_middleware_reads_and_writes_the_same_bytes(messages: list[tuple[str, str, Any]]) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy", exc_type=ImportError)
    serialization = importlib.import_module("rclpy.serialization")
    for topic, type_name, message in messages:
        data = ros_types.encode(type_name, message)
        decoded = serialization.deserialize_message(data, ros_class(type_name))
        assert plain(decoded) == plain(ros_types.decode(type_name, data)), topic
        again = serialization.serialize_message(decoded)
        # The middleware leaves whatever was in its buffer between aligned fields, so its bytes are read once more.
        assert 0 <= len(again) - len(data) < 4, topic
        assert ros_types.encode(type_name, ros_types.decode(type_name, again)) == data, topic


def test_messages_of_the_middleware_convert_the_same(messages: list[tuple[str, str, Any]]) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy", exc_type=ImportError)
    serialization = importlib.import_module("rclpy.serialization")
    for topic, type_name, message in messages:
        if topic in INPUT_TYPES:
            data = ros_types.encode(type_name, message)
            decoded = serialization.deserialize_message(data, ros_class(type_name))
            ours, theirs = measurement_from_message(type_name, message), measurement_from_message(type_name, decoded)
            assert plain(ours) == plain(theirs), topic


@pytest.mark.parametrize("type_name", sorted({*INPUT_TYPES.values(), *OUTPUT_TYPES.values()}))
def test_type_hash_is_that_of_the_ros_build(type_name: str) -> None:
    package, _, name = type_name.split("/")
    ros_class(type_name)
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix]
    files = [Path(prefix) / "share" / package / "msg" / f"{name}.json" for prefix in prefixes if prefix]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        pytest.skip(f"needs share/{package}/msg/{name}.json of a ROS 2 build")
    description = json.loads(found.read_text(encoding="utf-8"))
    hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
    assert ros_types.type_hash(type_name) == hashes[type_name]


def test_kitti_recording_is_written_again_unchanged(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap"
    with BagReader(source) as reader:
        original = list(reader.messages())
        with BagWriter(tmp_path / "again.mcap") as bag:
            for topic, type_name, t, data in original:
                bag.write(topic, type_name, ros_types.decode(type_name, data), t)
    with BagReader(tmp_path / "again.mcap") as reader:
        again = list(reader.messages())
    assert [entry[:3] for entry in again] == [entry[:3] for entry in original]
    for (topic, _, t, new), (_, _, _, old) in zip(again, original, strict=True):
        assert new == old[: len(new)], (topic, t)
        assert len(old) - len(new) < 4
