# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read one file of a recording, MCAP or SQLite: its channels, and their messages by log time."""

from __future__ import annotations

import contextlib
import functools
import re
import sqlite3
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.records import Channel
from rosbags.interfaces import MessageDefinitionFormat, QosDurability
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from ba_node.io import ros_types
from ba_node.io.bag_topics import BagError, EmptyBagError, absolute
from ba_node.io.files import FileKindError, open_regular
from ba_node.io.mcap_index import MAX_CHUNK_BYTES, BagIndex, Message, read_index, read_messages

# Any recording; devices and pipes are refused.
MAX_BYTES = 2**62
_SQLITE_MAGIC = b"SQLite format 3\x00"
# By name, or by number as recorders before Iron write it.
_LATCHED = re.compile(r"durability: (transient_local|1)\b")
_ENCODINGS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}


@dataclass(frozen=True)
class BagChannel:
    """Messages of one topic and type in one file."""

    id: int  # in its file
    topic: str  # full name, with the slash that other writers leave out
    type_name: str  # ``package/msg/Type``; empty if the file does not say
    encoding: tuple[str, str]  # of messages and of definitions, as the file names them
    definition: str  # of the type
    count: int | None  # messages in it, None if that is not known
    is_latched: bool = False  # the last message was kept for those who come later (transient_local)


@dataclass(frozen=True)
class Source:
    """One open file."""

    channels: list[BagChannel]  # all
    message_count: int  # messages that can be read
    start_ns: int  # log time of the first, ns
    end_ns: int  # log time of the last, ns
    problems: list[tuple[str, str]]  # what is wrong with it, as (reason, words)
    # yields the messages of some channels by log time; what cannot be read goes to the function given
    read: Callable[[Collection[int], Callable[[str, str], None]], Iterator[Message]]


def open_source(path: Path, name: Path, stack: contextlib.ExitStack) -> Source:
    """Open a file, closed by the stack; errors call it ``name``, as it may have been unpacked from another.

    Raises:
        BagError: it cannot be opened, is of another kind, or holds no message that can be read.
    """
    try:
        stream = stack.enter_context(open_regular(path, MAX_BYTES))
        head = stream.read(len(_SQLITE_MAGIC))
        stream.seek(0)
        return _sqlite(path, stack) if head == _SQLITE_MAGIC else _mcap(stream, path.stat().st_size)
    except BagError as error:
        raise type(error)(f"{name}: {error}") from None
    except FileKindError as error:
        raise BagError(str(error)) from None
    except OSError as error:
        raise BagError(f"{name}: cannot be opened: {error.strerror}") from error


def _mcap(stream: IO[bytes], size: int) -> Source:
    """Index an MCAP file, whole or damaged."""
    index = read_index(stream, size)
    channels = [_mcap_channel(index, channel) for channel in index.channels.values()]
    start_ns = index.blocks[0].start_ns if index.blocks else 0
    read = functools.partial(read_messages, stream, index)
    return Source(channels, index.message_count, start_ns, index.end_ns, index.problems, read)


def _mcap_channel(index: BagIndex, channel: Channel) -> BagChannel:
    schema = index.schemas.get(channel.schema_id)
    return BagChannel(
        channel.id,
        absolute(channel.topic),
        "" if schema is None else ros_types.full_name(schema.name),
        (channel.message_encoding, "" if schema is None else schema.encoding),
        "" if schema is None else schema.data.decode("utf-8", errors="replace"),
        index.counts[channel.id] if index.counts else None,
        _LATCHED.search(channel.metadata.get("offered_qos_profiles", "")) is not None,
    )


def _sqlite(path: Path, stack: contextlib.ExitStack) -> Source:
    """Open an SQLite file of rosbag2; those before Jazzy hold no definitions, so that ours are taken."""
    reader = Sqlite3Reader(path)
    try:
        _check_tables(path)
        reader.open()
        stack.callback(reader.close)
        about = reader.metadata
        channels = [_sqlite_channel(connection) for connection in reader.connections]
        query = "SELECT count(*) FROM messages WHERE topic_id NOT IN (SELECT id FROM topics)"
        ((strays,),) = _query(reader, query)
    except Exception as error:  # a damaged database leads the library into errors of every kind
        raise BagError(f"not an SQLite recording of rosbag2, or damaged: {error}") from error
    if about.message_count == 0:
        raise EmptyBagError("no message can be read: it was closed before anything was recorded")
    problems = []
    if strays:
        problems.append(("corrupt", f"{strays} of {about.message_count} messages name a topic that it does not have"))
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        words = f"{journal.name} beside it holds messages that were not written into it: open it with sqlite3 once"
        problems.append(("truncated", words))
    read = functools.partial(_read_sqlite, reader)
    return Source(channels, about.message_count, about.start_time, about.end_time - 1, problems, read)


def _check_tables(path: Path) -> None:
    """Raise ValueError unless what is read are tables whose content stands in the file, not made up as it is read."""
    with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
        tables = "('messages', 'topics', 'message_definitions', 'schema')"
        for name, kind, sql in database.execute(f"SELECT name, type, sql FROM sqlite_master WHERE name IN {tables}"):
            columns = database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            if kind != "table" or str(sql).lower().startswith("create virtual") or any(c[-1] for c in columns):
                raise ValueError(f"{name} is a view, or has columns that are reckoned: expected a table of values")


def _query(reader: Sqlite3Reader, query: str, values: tuple[Any, ...] = ()) -> Any:
    """Return an iterator over the rows that a query gives."""
    assert reader.dbconn is not None
    return reader.dbconn.cursor().execute(query, values)


def _read_sqlite(
    reader: Sqlite3Reader, channels: Collection[int], report: Callable[[str, str], None]
) -> Iterator[Message]:
    # The library's own reading takes whatever size a message has, and sorts whole messages where times have no index.
    query = (
        "SELECT rowid, topic_id, timestamp, length(data) FROM messages"
        f" WHERE topic_id IN ({','.join(map(str, channels))}) ORDER BY timestamp"
    )
    try:
        for row, channel, log_time, size in _query(reader, query):
            if size is not None and size > MAX_CHUNK_BYTES:
                words = f"message {row} has {size >> 20} MB: expected {MAX_CHUNK_BYTES >> 20} MB at most"
                report("corrupt", words)
                continue
            ((data,),) = _query(reader, "SELECT data FROM messages WHERE rowid = ?", (row,))
            yield Message(channel, log_time, data)
    except Exception as error:  # as when it is opened
        report("corrupt", f"the database is damaged: {error}")


def _sqlite_channel(connection: Any) -> BagChannel:
    if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
        raise BagError(f"topic {connection.topic!r} of type {connection.msgtype!r}: expected two names")
    type_name = ros_types.full_name(connection.msgtype)
    definition, kind = connection.msgdef.data, _ENCODINGS.get(connection.msgdef.format, "ros2msg")
    if not definition and ros_types.is_known(type_name):
        definition = ros_types.schema_text(type_name)
    encoding = (connection.ext.serialization_format, kind)
    latched = any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in connection.ext.offered_qos_profiles)
    topic = absolute(connection.topic)
    return BagChannel(connection.id, topic, type_name, encoding, definition, connection.msgcount, latched)
