# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give damaged recordings to the reader: it says what is wrong, or gives what is whole and counts the rest."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
import pytest
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from ba_node.io import ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.mcap_index import MAGIC
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from ba_node.messages.conversion import input_message
from ba_node.messages.topics import INPUT_TYPES

if TYPE_CHECKING:
    from pathlib import Path

F = ROSBAGS_FACTORY
N_KEYFRAMES = 12


def frame(i: int) -> tuple[Keyframe, FeatureTracks]:
    rng = np.random.default_rng(i)
    keyframe = Keyframe(0, i, 1000 * i, "map", rng.normal(size=3), np.array([0.0, 0.0, 0.0, 1.0]))
    return keyframe, FeatureTracks(0, i, 0, rng.integers(0, 2**64, size=9, dtype=np.uint64), rng.normal(size=(9, 2)))


def record(rig: CameraRig, chunk_size: int, compression: CompressionType, chunking: bool = True) -> bytes:
    """Return a recording of a rig and twelve keyframes with tracks in small chunks."""
    stream = BytesIO()
    writer = Writer(stream, chunk_size=chunk_size, compression=compression, use_chunking=chunking)
    writer.start("ros2")
    channels = {}
    for name in ("camera_rig", "keyframes", "feature_tracks"):
        text = ros_types.schema_text(INPUT_TYPES[name]).encode()
        schema = writer.register_schema(INPUT_TYPES[name], "ros2msg", text)
        channels[name] = writer.register_channel(f"/{name}", "cdr", schema)

    def write(name: str, message: object, t: int) -> None:
        writer.add_message(channels[name], t, ros_types.encode(INPUT_TYPES[name], message), t)

    write("camera_rig", input_message(F, rig, 0)[1], 0)
    for i in range(N_KEYFRAMES):
        keyframe, tracks = frame(i)
        write("keyframes", input_message(F, keyframe)[1], i)
        write("feature_tracks", input_message(F, tracks, 0, "c")[1], i)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def read(path: Path, data: bytes) -> tuple[list[tuple[str, int]], BagReader]:
    path.write_bytes(data)
    with BagReader(path) as reader:
        found = [(topic, t) for topic, t, _ in reader.measurements()]
    return found, reader


EXPECTED = [("/camera_rig", 0), *((t, i) for i in range(N_KEYFRAMES) for t in ("/keyframes", "/feature_tracks"))]


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("chunking", [True, False])
def test_truncated_anywhere_gives_what_is_whole_or_says_why_not(
    tmp_path: Path, rig: CameraRig, compression: CompressionType, chunking: bool
) -> None:
    data = record(rig, 1000, compression, chunking)
    path = tmp_path / "t.mcap"
    assert read(path, data)[0] == EXPECTED
    lengths = set(range(0, len(data), 97)) | set(range(len(data) - 60, len(data)))
    partial = 0
    failures = []
    for length in sorted(lengths):
        try:
            found, reader = read(path, data[:length])
        except BagError as error:
            failures.append(str(error))
            continue
        assert found == EXPECTED[: len(found)], length
        partial += len(found) < len(EXPECTED)
        if len(found) < len(EXPECTED):
            assert reader.rejected["truncated"] == 1, length
            assert f"truncated after {len(found)} messages" in reader.rejection_notes[0]
    assert all(str(path) in failure for failure in failures)
    assert partial > 10, "no truncation left a part of the recording"


def test_flipped_bytes_never_crash(tmp_path: Path, rig: CameraRig) -> None:
    data = bytearray(record(rig, 1000, CompressionType.ZSTD))
    rng = np.random.default_rng(8)
    outcomes = {"whole": 0, "partial": 0, "error": 0}
    for _ in range(400):
        broken = data.copy()
        for place in rng.integers(0, len(data), size=rng.integers(1, 4)):
            broken[place] = rng.integers(0, 256)
        try:
            found, reader = read(tmp_path / "t.mcap", bytes(broken))
        except BagError:
            outcomes["error"] += 1
            continue
        outcomes["partial" if reader.rejected else "whole"] += 1
        assert len(found) + sum(reader.rejected.values()) > 0
    assert min(outcomes.values()) > 0, outcomes


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"\x89MCAP", "not an MCAP file"),
        (b"SQLite format 3\x00" + bytes(100), "not an SQLite recording of rosbag2, or damaged"),
        (MAGIC, "no message can be read: truncated after 0 messages"),
        (MAGIC + bytes(range(256)), "no message can be read"),
        (MAGIC + b"\x06" + b"\xff" * 8 + bytes(50), "no message can be read: truncated after 0 messages"),
    ],
)
def test_what_is_no_recording_is_an_error(tmp_path: Path, data: bytes, words: str) -> None:
    with pytest.raises(BagError, match=words):
        read(tmp_path / "t.mcap", data)


def test_missing_file_and_folder_are_errors(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file"), BagReader(tmp_path / "x.mcap"):
        pass
    with pytest.raises(BagError, match=r"no recording in this folder: expected \.mcap or \.db3"), BagReader(tmp_path):
        pass


def test_a_recording_without_messages_is_an_error(tmp_path: Path) -> None:
    stream = BytesIO()
    writer = Writer(stream)
    writer.start("ros2")
    writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(BagError, match="no message can be read: it was closed before anything was recorded"):
        read(tmp_path / "t.mcap", stream.getvalue())


@pytest.mark.parametrize(
    ("begin", "words"),
    [
        (b"\x28\xb5\x2f\xfd", "packed with zstd: unpack it, or name it .mcap.zstd"),
        (b"\x1f\x8b\x08", "packed with gzip"),
        (b"PK\x03\x04", "a zip archive"),
        (b"#ROSBAG V2.0\n", "a recording of ROS 1: convert it"),
        (b"something else", "magic bytes$"),
    ],
)
def test_what_a_file_is_instead_is_named(begin: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "other.mcap").write_bytes(begin + bytes(100))
    with pytest.raises(BagError, match=words), BagReader(tmp_path / "other.mcap"):
        pass


def test_unknown_compression_is_named(tmp_path: Path) -> None:
    builder = RecordBuilder()
    Chunk("brotli", b"abc", 1, 0, 0, 3).write(builder)
    with pytest.raises(BagError, match="chunk compression 'brotli' is unknown: expected zstd, lz4 or none"):
        read(tmp_path / "t.mcap", MAGIC + builder.end())  # type: ignore[no-untyped-call]


def rewrite(
    rig: CameraRig, name: str, text: str | None = None, payload: bytes | None = None, cdr: str = "cdr"
) -> bytes:
    """Return a recording where one topic has another definition, or its second message other bytes."""
    stream = BytesIO()
    writer = Writer(stream)
    writer.start("ros2")
    keyframe, tracks = frame(1)
    messages = {
        "camera_rig": input_message(F, rig, 0)[1],
        "keyframes": input_message(F, keyframe)[1],
        "feature_tracks": input_message(F, tracks, 0, "c")[1],
    }
    for topic, message in messages.items():
        kind = INPUT_TYPES[topic]
        definition = text if topic == name and text is not None else ros_types.schema_text(kind)
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        channel = writer.register_channel(f"/{topic}", cdr if topic == name else "cdr", schema)
        data = ros_types.encode(kind, message)
        writer.add_message(channel, 0, data, 0)
        writer.add_message(channel, 1, payload if topic == name and payload is not None else data, 1)
        writer.add_message(channel, 2, data, 2)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def test_a_definition_without_a_field_is_an_error_that_names_it(tmp_path: Path, rig: CameraRig) -> None:
    full = ros_types.schema_text(INPUT_TYPES["feature_tracks"])
    cases = [
        (full.replace("float32[] u\n", ""), r"/feature_tracks: .*has no field u \(expected float32\[\]\)"),
        (full.replace("uint64[] track_id", "int32[] track_id"), r"field track_id is int32\[\], expected uint64\[\]"),
        (full.replace("uint32 nanosec", "uint32 nsec"), "builtin_interfaces/msg/Time has no field nanosec"),
        ("not a definition ][", "cannot be read"),
        ("", "has no field header"),
    ]
    for text, words in cases:
        with pytest.raises(BagError, match=words):
            read(tmp_path / "t.mcap", rewrite(rig, "feature_tracks", text=text))
    with pytest.raises(BagError, match=r"messages in 'json'.*expected 'cdr' and 'ros2msg'"):
        read(tmp_path / "t.mcap", rewrite(rig, "keyframes", cdr="json"))


def test_a_definition_with_more_fields_is_read_by_itself(tmp_path: Path, rig: CameraRig) -> None:
    text = ros_types.schema_text(INPUT_TYPES["keyframes"])
    text = text.replace(
        "geometry_msgs/PoseWithCovariance pose\n", "geometry_msgs/PoseWithCovariance pose\nuint8[] more\n"
    )
    longer = ros_types.encode(INPUT_TYPES["keyframes"], input_message(F, frame(1)[0])[1]) + b"\x02\x00\x00\x00ab"
    found, reader = read(tmp_path / "t.mcap", rewrite(rig, "keyframes", text=text, payload=longer))
    # The two messages without the new field are short of what their definition says.
    assert reader.rejected == {"undecodable": 2}
    assert [t for topic, t in found if topic == "/keyframes"] == [1]


@pytest.mark.parametrize("name", ["keyframes", "feature_tracks", "camera_rig"])
def test_a_broken_message_is_counted_and_the_rest_is_read(tmp_path: Path, rig: CameraRig, name: str) -> None:
    keyframe, tracks = frame(1)
    whole = {
        "camera_rig": input_message(F, rig, 0)[1],
        "keyframes": input_message(F, keyframe)[1],
        "feature_tracks": input_message(F, tracks, 0, "c")[1],
    }[name]
    data = ros_types.encode(INPUT_TYPES[name], whole)
    for payload in (
        b"",
        data[:3],
        data[:20],
        data[:-1],
        data + bytes(16),
        b"\xff" * len(data),
        b"\0\1\0\0" + b"\xff" * 99,
    ):
        found, reader = read(tmp_path / "t.mcap", rewrite(rig, name, payload=payload))
        assert reader.rejected == {"undecodable": 1}, len(payload)
        assert f"topic /{name}, message 1: " in reader.rejection_notes[0]
        assert [t for topic, t in found if topic == f"/{name}"] == [0, 2]
        assert len(found) == 8


def test_a_rig_of_unequal_lengths_is_counted(tmp_path: Path, rig: CameraRig) -> None:
    message = input_message(F, rig, 0)[1]
    message.body_from_camera.pop()
    payload = ros_types.encode(INPUT_TYPES["camera_rig"], message)
    (tmp_path / "t.mcap").write_bytes(rewrite(rig, "camera_rig", payload=payload))
    with BagReader(tmp_path / "t.mcap") as reader:
        rigs = [measurement for _, _, measurement in reader.measurements() if isinstance(measurement, CameraRig)]
    assert not reader.rejected
    assert sum(found.malformed.startswith("cameras has 2 entries, body_from_camera 1") for found in rigs) == 1
