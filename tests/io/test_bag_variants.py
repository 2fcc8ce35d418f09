# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that other writers leave: names without a slash, definitions in IDL, an index or a list that lies."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype

from ba_node.cli.main import main
from ba_node.io import ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.offline.recording import record
from experiments.synthetic import SyntheticOptions, generate
from tests.io.test_bag_folders import split, write_metadata

Message = tuple[str, str, int, bytes]


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    path = tmp_path_factory.mktemp("whole") / "all.mcap"
    data = generate(SyntheticOptions(keyframes=8, landmarks=300, tracks=40, length_m=10.0, seed=4))
    record(path, data.timeline(), data.truth)
    return read(path)


def read(path: Path) -> list[Message]:
    with BagReader(path) as reader:
        found = list(reader.messages())
        assert not reader.rejected and reader.message_count == len(found)
        assert len(list(reader.measurements())) > 0
        return found


def write(
    path: Path,
    messages: list[Message],
    language: str = "ros2msg",
    definition: Callable[[str], str] = ros_types.schema_text,
) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2048, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="another")
        channels: dict[tuple[str, str], int] = {}
        for topic, kind, time, data in messages:
            if (topic, kind) not in channels:
                schema = writer.register_schema(kind, language, definition(kind).encode())
                channels[topic, kind] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, kind], time, data, publish_time=time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_names_without_a_slash_are_those_with_one(tmp_path: Path, messages: list[Message]) -> None:
    bare = [(m[0].removeprefix("/"), *m[1:]) for m in messages]
    mixed = [(m if i % 2 else bare[i]) for i, m in enumerate(messages)]
    assert read(write(tmp_path / "bare.mcap", bare)) == messages
    assert sorted(read(write(tmp_path / "mixed.mcap", mixed))) == sorted(messages)


def idl(kind: str) -> str:
    """Return the definition of a type and of all in it as rosidl writes IDL and rosbag2 puts it into a file."""
    done: dict[str, str] = {}

    def add(name: str) -> None:
        if name in done:
            return
        done[name] = ""
        lines = []
        for field, description in ros_types.typestore().fielddefs[name][1]:
            lines.append(f"      {shown(description)} {field}{size(description)};")
        package, _, short = name.split("/")
        head = '// generated from rosidl_adapter\n#include "std_msgs/msg/Header.idl"\n'
        done[name] = (
            f"{head}module {package} {{\n  module msg {{\n    struct {short} {{\n"
            + "\n".join(lines)
            + "\n    };\n  };\n};\n"
        )

    def shown(description: Any) -> str:
        node, value = description
        if node == Nodetype.NAME:
            add(str(value))
            return str(value).replace("/", "::")
        if node == Nodetype.BASE:
            return {"float64": "double", "float32": "float", "bool": "boolean"}.get(value[0], str(value[0]))
        inner = shown(value[0])
        return inner if node == Nodetype.ARRAY else f"sequence<{inner}>"

    def size(description: Any) -> str:
        return f"[{description[1][1]}]" if description[0] == Nodetype.ARRAY else ""

    add(kind)
    return "".join(f"{'=' * 80}\nIDL: {name}\n{text}" for name, text in done.items())


def test_definitions_in_idl_are_read(tmp_path: Path, messages: list[Message]) -> None:
    path = write(tmp_path / "idl.mcap", messages, "ros2idl", idl)
    assert read(path) == messages
    other = write(tmp_path / "other.mcap", messages, "ros2idl", lambda kind: idl(kind).replace("track_id", "id"))
    with BagReader(other) as reader, pytest.raises(BagError, match="has no field track_id"):
        reader.measurements()


def test_definitions_may_have_lines_as_on_windows(tmp_path: Path, messages: list[Message]) -> None:
    path = write(
        tmp_path / "crlf.mcap", messages, definition=lambda kind: ros_types.schema_text(kind).replace("\n", "\r\n")
    )
    assert read(path) == messages


def test_another_form_of_cdr_is_named(tmp_path: Path, messages: list[Message], capsys: Any) -> None:
    path = write(tmp_path / "cdr2.mcap", [(*m[:3], b"\0\7" + m[3][2:]) for m in messages])
    assert main(["replay", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "serialised as 0007, another form of CDR" in capsys.readouterr().err
    assert main(["info", str(path)]) == 3
    assert len(capsys.readouterr().err.splitlines()) < 8, "no line for each message"


def records(data: bytearray) -> Iterator[tuple[int, int]]:
    """Yield opcode and place of the content of all records."""
    at = 8
    while at + 9 <= len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, at + 9
        at += 9 + length


def shifted(data: bytearray) -> None:
    for opcode, at in records(data):
        if opcode == Opcode.CHUNK_INDEX:
            (offset,) = struct.unpack_from("<Q", data, at + 16)
            struct.pack_into("<Q", data, at + 16, offset + 17)


def left_out(data: bytearray) -> None:
    places = [at for opcode, at in records(data) if opcode == Opcode.CHUNK_INDEX]
    for at in places[1:3]:
        data[at - 9] = 0x70  # of no meaning, so that readers pass it over


def another_time(data: bytearray) -> None:
    places = [at for opcode, at in records(data) if opcode == Opcode.CHUNK_INDEX]
    struct.pack_into("<QQ", data, places[0], 10**18, 10**18)


def another_count(data: bytearray) -> None:
    struct.pack_into("<Q", data, next(at for opcode, at in records(data) if opcode == Opcode.STATISTICS), 99_999)


@pytest.mark.parametrize("spoil", [shifted, left_out, another_time, another_count])
def test_an_index_that_lies_costs_nothing(
    spoil: Callable[[bytearray], None], tmp_path: Path, messages: list[Message]
) -> None:
    path = write(tmp_path / "index.mcap", messages)
    data = bytearray(path.read_bytes())
    assert sum(opcode == Opcode.CHUNK_INDEX for opcode, _ in records(data)) > 3
    spoil(data)
    path.write_bytes(data)
    assert read(path) == messages


def test_files_that_metadata_does_not_list_are_said(tmp_path: Path, messages: list[Message]) -> None:
    folder = tmp_path / "bag"
    paths = split(folder, messages, 3)
    write_metadata(folder, [path.name for path in paths[:2]], storage_identifier=None)
    (folder / "notes.mcap").write_bytes(paths[0].read_bytes())
    with BagReader(folder) as reader:
        assert len(list(reader.messages())) < len(messages)
        assert list(reader.warnings) == ["unlisted_files"]
        assert "does not list part_2.mcap: left aside" in reader.warnings["unlisted_files"]


def test_a_missing_part_with_the_rig_is_the_cause_that_is_named(tmp_path: Path, messages: list[Message]) -> None:
    folder = tmp_path / "bag"
    paths = split(folder, messages, 4)
    write_metadata(folder, [path.name for path in paths])
    paths[0].unlink()
    with BagReader(folder) as reader, pytest.raises(BagError, match=r"no topic of type .*CameraRig.*1 of its 4 files"):
        reader.measurements()
