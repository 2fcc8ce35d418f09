# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader as RosbagsReader

from ba_node.config import OutputConfig
from ba_node.io import ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.bag_writer import BagWriter
from ba_node.io.mcap_index import read_index
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.conversion import input_message
from ba_node.messages.outputs import output_messages
from ba_node.messages.topics import INPUT_TYPES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ba_node.estimate import Estimate

F = ROSBAGS_FACTORY


def write_inputs(
    path: Path, keyframe: Keyframe, tracks: FeatureTracks, guesses: LandmarkGuesses, rig: CameraRig
) -> None:
    with BagWriter(path) as bag:
        bag.write("/camera_rig", INPUT_TYPES["camera_rig"], input_message(F, rig, 5)[1], 5, latched=True)
        bag.write("/keyframes", INPUT_TYPES["keyframes"], input_message(F, keyframe)[1], 10)
        bag.write("/feature_tracks", INPUT_TYPES["feature_tracks"], input_message(F, tracks, 5, "c")[1], 10)
        bag.write("/landmark_guesses", INPUT_TYPES["landmark_guesses"], input_message(F, guesses, 5, "map")[1], 7)


@pytest.fixture
def bag(tmp_path: Path, keyframe: Keyframe, tracks: FeatureTracks, guesses: LandmarkGuesses, rig: CameraRig) -> Path:
    path = tmp_path / "in.mcap"
    write_inputs(path, keyframe, tracks, guesses, rig)
    return path


def same(a: Any, b: Any) -> bool:
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return bool(a == b)


def test_what_was_written_is_read_in_log_time_order(
    bag: Path, keyframe: Keyframe, tracks: FeatureTracks, guesses: LandmarkGuesses, rig: CameraRig
) -> None:
    with BagReader(bag) as reader:
        found = list(reader.measurements())
        assert reader.message_count == 4
        assert not reader.rejected
        names = ("camera_rig", "keyframes", "feature_tracks", "landmark_guesses")
        assert reader.topics == {f"/{name}": INPUT_TYPES[name] for name in names}
    expected = [("/camera_rig", 5, rig), ("/landmark_guesses", 7, guesses)]
    expected += [("/keyframes", 10, keyframe), ("/feature_tracks", 10, tracks)]
    assert [(topic, t) for topic, t, _ in found] == [(topic, t) for topic, t, _ in expected]
    for (topic, _, got), (_, _, want) in zip(found, expected, strict=True):
        assert same(got, want), topic


def test_same_messages_make_the_same_bytes(tmp_path: Path, estimate: Estimate) -> None:
    data = []
    for name in ("a.mcap", "b.mcap"):
        with BagWriter(tmp_path / name) as bag:
            for topic, type_name, message in output_messages(F, estimate, OutputConfig()):
                bag.write(f"/ba_node/{topic}", type_name, message, estimate.stamp_ns, topic in ("path", "points"))
        data.append((tmp_path / name).read_bytes())
    assert data[0] == data[1]
    assert len(data[0]) > 1000


def test_form_is_that_of_rosbag2(bag: Path) -> None:
    with bag.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert {channel.message_encoding for channel in channels.values()} == {"cdr"}
    forever = {"sec": 9223372036, "nsec": 854775807}
    for topic, durability, depth in (("/camera_rig", "transient_local", 1), ("/keyframes", "volatile", 10)):
        (profile,) = yaml.safe_load(channels[topic].metadata["offered_qos_profiles"])
        assert profile == {
            "history": "keep_last",
            "depth": depth,
            "reliability": "reliable",
            "durability": durability,
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }
        assert channels[topic].metadata["topic_type_hash"].startswith("RIHS01_")


def test_nothing_is_left_of_a_file_that_failed(tmp_path: Path, keyframe: Keyframe) -> None:
    old = tmp_path / "out.mcap"
    old.write_bytes(b"older recording")

    def write_half() -> None:
        with BagWriter(old) as bag:
            bag.write("/keyframes", INPUT_TYPES["keyframes"], input_message(F, keyframe)[1], 1)
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_half()
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]
    assert old.read_bytes() == b"older recording"


def test_writer_names_what_does_not_fit(tmp_path: Path, keyframe: Keyframe, rig: CameraRig) -> None:
    message = input_message(F, keyframe)[1]
    with BagWriter(tmp_path / "out.mcap") as bag:
        bag.write("k", INPUT_TYPES["keyframes"], message, 2**64 - 1)
        with pytest.raises(BagError, match=r"topic /k: log time -1 ns"):
            bag.write("/k", INPUT_TYPES["keyframes"], message, -1)
        with pytest.raises(BagError, match="a topic keeps both"):
            bag.write("/k", INPUT_TYPES["keyframes"], message, 1, latched=True)
        with pytest.raises(BagError, match="message does not fit ba_msgs/msg/Keyframe"):
            bag.write("/other", INPUT_TYPES["keyframes"], input_message(F, rig, 0)[1], 1)
    with BagReader(tmp_path / "out.mcap") as reader:
        assert reader.topics == {"/k": "ba_msgs/msg/Keyframe"}
        assert [t for _, _, t, _ in reader.messages()] == [2**64 - 1]


def write_times(path: Path, times: list[int], chunk_size: int, compression: CompressionType, **options: Any) -> None:
    """Write a message at each of the times; its content is its place in the file."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=compression, **options)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/s", "cdr", schema)
        for place, t in enumerate(times):
            writer.add_message(channel, t, str(place).encode(), publish_time=0)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("chunk_size", [1, 200, 10**6])
@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_order_is_log_time_then_place_in_the_file(
    tmp_path: Path, chunk_size: int, summary: bool, chunking: bool, compression: CompressionType
) -> None:
    times = np.random.default_rng(3).integers(0, 20, size=100).tolist()
    path = tmp_path / "t.mcap"
    options = {} if summary else {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
    write_times(path, times, chunk_size, compression, use_chunking=chunking, **options)
    with BagReader(path) as reader:
        found = [(t, int(data)) for _, _, t, data in reader.messages()]
        assert reader.message_count == 100
        assert not reader.rejected
    assert found == sorted((t, place) for place, t in enumerate(times))


def test_reads_chunk_by_chunk(tmp_path: Path) -> None:
    path = tmp_path / "t.mcap"
    write_times(path, [5] * 50 + list(range(5, 55)), 200, CompressionType.NONE)
    with BagReader(path) as reader:
        with path.open("rb") as stream:
            n_chunks = len(read_index(stream, path.stat().st_size).blocks)
        assert n_chunks > 10
        messages = reader.messages()
        next(messages)
        # The file now ends behind what was read: had more than the first chunks been opened, all would be known.
        path.write_bytes(path.read_bytes()[: len(path.read_bytes()) // 2])
        read = 1 + sum(1 for _ in messages)
    assert 0 < read < 100, f"{read} messages were in memory after the first"
    assert reader.rejected["corrupt"] > 0


def test_several_iterations_do_not_disturb_each_other(bag: Path) -> None:
    with BagReader(bag) as reader:
        pairs = list(zip(reader.messages(), reader.messages(["/keyframes"]), strict=False))
        assert pairs[0][0][0] == "/camera_rig"
        assert pairs[0][1][0] == "/keyframes"
        assert len(list(reader.messages())) == 4


def copy_bag(source: Path, target: Path, topics: dict[str, list[str]], names: dict[str, str] | None = None) -> None:
    """Write the messages of a bag again, each topic under new names, with other names of schemas."""
    names = names or {}
    with source.open("rb") as old, target.open("wb") as new:
        writer = Writer(new)
        writer.start("ros2")
        for schema, channel, message in make_reader(old).iter_messages():
            assert schema is not None
            schema_id = writer.register_schema(names.get(schema.name, schema.name), schema.encoding, schema.data)
            for topic in topics.get(channel.topic, []):
                channel_id = writer.register_channel(topic, channel.message_encoding, schema_id)
                writer.add_message(channel_id, message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize(
    ("written", "chosen"),
    [
        (["/robot/keyframes"], "/robot/keyframes"),
        (["/odometry/kf"], "/odometry/kf"),
        (["/a", "/z/keyframes"], "/z/keyframes"),
        (["/b/keyframes", "/a/keyframes"], "/a/keyframes"),
    ],
)
def test_topics_are_known_by_type_and_then_by_name(tmp_path: Path, bag: Path, written: list[str], chosen: str) -> None:
    space = chosen.rpartition("/")[0]
    tracks = ["/0/feature_tracks", f"{space}/feature_tracks"]
    copy_bag(bag, tmp_path / "c.mcap", {"/keyframes": written, "/feature_tracks": tracks, "/camera_rig": ["/rig"]})
    with BagReader(tmp_path / "c.mcap") as reader:
        assert {topic for topic, _, _ in reader.measurements()} == {chosen, f"{space}/feature_tracks", "/rig"}


def test_a_second_type_on_a_topic_is_passed_over(tmp_path: Path, bag: Path) -> None:
    topics = {"/keyframes": ["/keyframes"], "/camera_rig": ["/camera_rig"], "/feature_tracks": ["/feature_tracks"]}
    other = tmp_path / "c.mcap"
    copy_bag(bag, other, topics | {"/landmark_guesses": ["/keyframes"]}, {INPUT_TYPES["landmark_guesses"]: "a/msg/B"})
    with BagReader(other) as reader:
        assert [topic for _, topic in sorted((t, topic) for topic, t, _ in reader.measurements())] == [
            "/camera_rig", "/feature_tracks", "/keyframes",
        ]  # fmt: skip
        assert not reader.rejected


@pytest.mark.parametrize("open_bag", [RosbagsReader, lambda path: AnyReader([path])])
def test_rosbags_opens_the_file_as_one_of_rosbag2(bag: Path, open_bag: Callable[[Path], Any]) -> None:
    with open_bag(bag) as reader:
        found = {c.topic: (c.msgtype, c.ext.offered_qos_profiles[0].durability.name) for c in reader.connections}
        assert reader.message_count == 4
    assert found["/camera_rig"] == ("ba_msgs/msg/CameraRig", "TRANSIENT_LOCAL")
    assert found["/keyframes"] == ("ba_msgs/msg/Keyframe", "VOLATILE")


def test_short_type_names_are_understood(tmp_path: Path, bag: Path) -> None:
    topics = {f"/{name}": [f"/{name}"] for name in INPUT_TYPES}
    short = {name: name.replace("/msg/", "/") for name in INPUT_TYPES.values()}
    copy_bag(bag, tmp_path / "c.mcap", topics, short)
    with BagReader(tmp_path / "c.mcap") as reader:
        assert reader.topics["/keyframes"] == "ba_msgs/msg/Keyframe"
        assert len(list(reader.measurements())) == 4


@pytest.mark.parametrize(
    ("left_out", "words"),
    [
        ("/keyframes", "no topic of type ba_msgs/msg/Keyframe"),
        ("/feature_tracks", "no topic of type ba_msgs/msg/FeatureTracks"),
        ("/camera_rig", "no topic of type ba_msgs/msg/CameraRig or sensor_msgs/msg/CameraInfo"),
    ],
)
def test_a_missing_topic_is_named_with_those_that_are_there(
    tmp_path: Path, bag: Path, left_out: str, words: str
) -> None:
    topics = {f"/{name}": [f"/{name}"] for name in INPUT_TYPES if f"/{name}" != left_out}
    copy_bag(bag, tmp_path / "c.mcap", topics)
    with BagReader(tmp_path / "c.mcap") as reader, pytest.raises(BagError, match=words) as caught:
        reader.measurements()
    assert "/landmark_guesses (ba_msgs/msg/LandmarkGuesses)" in str(caught.value)


def test_camera_info_counts_only_without_a_rig(tmp_path: Path, keyframe: Keyframe, rig: CameraRig) -> None:
    info = input_message(F, rig, 0)[1].cameras[0]
    for with_rig in (True, False):
        path = tmp_path / f"{with_rig}.mcap"
        empty = FeatureTracks(0, 0, 0, np.empty(0, np.uint64), np.empty((0, 2)))
        with BagWriter(path) as out:
            out.write("/left/camera_info", INPUT_TYPES["camera_info"], info, 1, latched=True)
            out.write("/keyframes", INPUT_TYPES["keyframes"], input_message(F, keyframe)[1], 2)
            out.write("/feature_tracks", INPUT_TYPES["feature_tracks"], input_message(F, empty, 0, "c")[1], 2)
            if with_rig:
                out.write("/camera_rig", INPUT_TYPES["camera_rig"], input_message(F, rig, 0)[1], 1, latched=True)
        with BagReader(path) as reader:
            sizes = [len(m) for _, _, m in reader.measurements() if isinstance(m, CameraRig)]
        assert sizes == ([2] if with_rig else [1])


def test_decode_gives_any_topic(bag: Path, keyframe: Keyframe) -> None:
    with BagReader(bag) as reader:
        ((topic, _, _, data),) = reader.messages(["/keyframes"])
        assert reader.decode(topic, data).keyframe_id == keyframe.keyframe_id
        with pytest.raises(BagError, match=r"no topic /x; there are: /camera_rig, /feature_tracks"):
            reader.decode("/x", data)
        with pytest.raises(BagError, match="topic /keyframes"):
            reader.decode(topic, data[:10])


def test_type_hashes_and_definitions_cover_all_types() -> None:
    for name in INPUT_TYPES.values():
        assert len(ros_types.type_hash(name)) == len("RIHS01_") + 64
        ros_types.check_definition(name, ros_types.schema_text(name))


def test_kitti_recording_of_another_program(shared_data: Path) -> None:
    with BagReader(shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap") as reader:
        found = list(reader.measurements())
        assert not reader.rejected
    counts = Counter(topic for topic, _, _ in found)
    assert counts == {"/camera_rig": 1, "/keyframes": 26, "/landmark_guesses": 25, "/feature_tracks": 52}
    tracks = [m for _, _, m in found if isinstance(m, FeatureTracks)]
    assert sum(len(t.track_id) for t in tracks) == 2 * 8189
    assert len(np.unique(np.concatenate([t.track_id for t in tracks]))) == 2634
    assert {t.malformed for t in tracks} == {""}
    assert {t.session_id for t in tracks} == {0}
    (rig,) = (m for _, _, m in found if isinstance(m, CameraRig))
    assert len(rig) == 2
    times = [t for _, t, _ in found]
    assert times == sorted(times)
    keyframes = [m for _, _, m in found if isinstance(m, Keyframe)]
    assert [k.stamp_ns for k in keyframes] == sorted(k.stamp_ns for k in keyframes)
