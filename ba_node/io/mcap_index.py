# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the messages of an MCAP file, whole or damaged, and give them in the order of their log times.

A file with a summary is indexed by it. One without (a recorder that was killed, a copy that broke off, a writer
that left it out) is indexed by one pass over its records. Either way the messages then come chunk by chunk: in
memory are only the chunks whose times overlap.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema

from ba_node.io.bag_topics import BagError, EmptyBagError
from ba_node.io.unpack import unpack

MAGIC = b"\x89MCAP0\r\n"
# Chunks of recorders hold a few MB. One of more than this is a trap or damaged, and so are more than this waiting.
MAX_CHUNK_BYTES = 2**27
MAX_CHUNK_RECORDS = 10**6
MAX_WAITING_BYTES = 2**29

# opcode (1 byte) and length (8 bytes) in front of every record
_HEAD = struct.Struct("<BQ")
# smallest log time in front of a chunk's content
_START = struct.Struct("<Q")
# channel, number, log time, publish time in front of a message's bytes
_MESSAGE = struct.Struct("<HIQQ")
# How files begin that are taken for a recording -> what to do with them.
_OTHERS = {
    b"\x28\xb5\x2f\xfd": "; it is packed with zstd: unpack it, or name it .mcap.zstd",
    b"\x1f\x8b": "; it is packed with gzip: unpack it",
    b"PK\x03\x04": "; it is a zip archive: unpack it",
    b"#ROSBAG": "; it is a recording of ROS 1: convert it, with rosbags-convert for one",
    **dict.fromkeys((b"\x89PNG", b"\xff\xd8\xff"), "; it is a picture: name the folder of all pictures"),
    **dict.fromkeys((b"ftyp", b"RIFF", b"\x1aE\xdf\xa3"), "; it is a video: write its images to a folder as pictures"),
}
_COMPRESSIONS = ("", "lz4", "zstd")


class Message(NamedTuple):
    """A message: number of its channel, log time in ns, bytes."""

    channel: int
    log_time: int
    data: bytes


class Block(NamedTuple):
    """A record that holds messages: a chunk, or a message that stands alone. Sorts by time, then place in the file."""

    start_ns: int  # smallest log time in it, ns
    offset: int  # where it begins, bytes
    length: int  # with its head, bytes
    channels: frozenset[int] | None = None  # those with messages in it; None if that is not known


@dataclass
class BagIndex:
    """Where the messages of a file are."""

    schemas: dict[int, Schema] = field(default_factory=dict)  # by id
    channels: dict[int, Channel] = field(default_factory=dict)  # by id
    blocks: list[Block] = field(default_factory=list)  # what holds messages, sorted
    message_count: int = 0  # number of messages that can be read
    counts: Counter[int] = field(default_factory=Counter)  # the same by channel; empty if that is not known
    end_ns: int = 0  # largest log time, ns
    problems: list[tuple[str, str]] = field(default_factory=list)  # what is wrong with the file, as (reason, words)

    def add(self, record: Message | Schema | Channel) -> None:
        """Take note of a schema or a channel; of those that come twice the first counts."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)


def read_index(stream: IO[bytes], size: int) -> BagIndex:
    """Return the index of a file of ``size`` bytes.

    Raises:
        BagError: it is empty, not MCAP, or holds no message that can be read.
    """
    if size == 0:
        raise BagError("the file is empty (0 bytes)")
    begin = stream.read(len(MAGIC))
    if begin != MAGIC:
        other = next((what for magic, what in _OTHERS.items() if begin.startswith(magic) or begin[4:] == magic), "")
        raise BagError(f"not an MCAP file: it does not begin with the MCAP magic bytes{other}")
    index = _from_summary(stream, size) or _from_records(stream, size)
    if index.message_count == 0:
        if not index.problems:
            raise EmptyBagError("no message can be read: it was closed before anything was recorded")
        raise BagError(f"no message can be read: {'; '.join(words for _, words in index.problems)}")
    return index


def read_messages(
    stream: IO[bytes], index: BagIndex, channels: Collection[int], report: Callable[[str, str], None]
) -> Iterator[Message]:
    """Yield the messages of some channels by log time; those of the same time in the order of the file.

    A block that cannot be read is passed over, and ``report`` gets the reason and the words.

    Raises:
        BagError: so many blocks overlap in time that they do not fit into memory.
    """
    wanted, open_bytes = frozenset(channels), 0

    def opened(block: Block) -> Iterator[Message]:
        nonlocal open_bytes
        messages = _sorted_messages(stream, index, block, wanted, report)
        size = sum(len(message.data) for message in messages)
        open_bytes += size
        if open_bytes > MAX_WAITING_BYTES:
            raise BagError(f"chunks of more than {MAX_WAITING_BYTES >> 20} MB overlap in time: split or sort it")
        yield from messages
        open_bytes -= size

    blocks = (block for block in index.blocks if block.channels is None or block.channels & wanted)
    return merge_by_time((block.start_ns, block.offset, opened(block)) for block in blocks)


def merge_by_time(parts: Iterator[tuple[int, int, Iterator[Message]]]) -> Iterator[Message]:
    """Yield the messages of all parts by log time; those of the same time by the place of their part.

    Parts are the log time (ns) of their first message, place, and messages by log time, sorted by the first two. A part
    is read only when its first message may come before all that wait.
    """
    part = next(parts, None)
    waiting: list[tuple[int, int, Message, Iterator[Message]]] = []
    while waiting or part:
        if part and (not waiting or part[:2] < waiting[0][:2]):
            _, place, messages = part
            part = next(parts, None)
        else:
            _, place, message, messages = heapq.heappop(waiting)
            yield message
        following = next(messages, None)
        if following:
            heapq.heappush(waiting, (following.log_time, place, following, messages))


def _sorted_messages(
    stream: IO[bytes], index: BagIndex, block: Block, channels: Collection[int], report: Callable[[str, str], None]
) -> list[Message]:
    try:
        records = _read_block(stream, block, channels)
    except BagError as error:
        report("corrupt", str(error))
        return []
    for record in records:
        index.add(record)
    messages = [record for record in records if isinstance(record, Message)]
    messages.sort(key=lambda message: message.log_time)
    return messages


def _from_summary(stream: IO[bytes], size: int) -> BagIndex | None:
    """Return the index that the file brings, or None if there is none that can be trusted."""
    try:
        stream.seek(0)
        summary = SeekingReader(stream, record_size_limit=size).get_summary()
    except Exception:  # broken bytes lead the parser into errors of every kind
        return None
    if summary is None or summary.statistics is None or not summary.chunk_indexes:
        return None
    used = {channel for chunk in summary.chunk_indexes for channel in chunk.message_index_offsets}
    # Writers may leave message indices out: then nothing is known about what is in which chunk.
    indexed = used >= summary.statistics.channel_message_counts.keys() and len(used) > 0
    blocks = [
        Block(
            c.message_start_time,
            c.chunk_start_offset,
            c.chunk_length,
            frozenset(c.message_index_offsets) if indexed and c.message_index_offsets else None,
        )
        for c in summary.chunk_indexes
    ]
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    counted = sum(summary.statistics.channel_message_counts.values()) == summary.statistics.message_count
    listed = len(blocks) == summary.statistics.chunk_count
    whole = counted and listed and all(_is_there(stream, block, size) for block in blocks)
    if not whole or not used <= summary.channels.keys() or not schemas <= summary.schemas.keys():
        return None
    if not summary.channels:
        return None
    return BagIndex(
        summary.schemas,
        summary.channels,
        sorted(blocks, key=_place),
        summary.statistics.message_count,
        Counter(summary.statistics.channel_message_counts),
        max(c.message_end_time for c in summary.chunk_indexes),
    )


def _is_there(stream: IO[bytes], block: Block, size: int) -> bool:
    """Return True if a chunk begins and ends where the index of a file of so many bytes says."""
    if block.offset + block.length > size:
        return False
    stream.seek(block.offset)
    head = stream.read(_HEAD.size + _START.size)
    if len(head) < _HEAD.size + _START.size:
        return False
    found = _HEAD.unpack_from(head), _START.unpack_from(head, _HEAD.size)
    return found == ((Opcode.CHUNK, block.length - _HEAD.size), (block.start_ns,))


def _place(block: Block) -> tuple[int, int]:
    return block.start_ns, block.offset


def _from_records(stream: IO[bytes], size: int) -> BagIndex:
    """Return the index found by going through all records, as far as they are whole."""
    index = BagIndex()
    offset, ended = len(MAGIC), False
    while not ended and offset + _HEAD.size <= size:
        stream.seek(offset)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        block = Block(0, offset, _HEAD.size + length)
        if offset + block.length > size:
            break
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            _index_block(stream, index, block)
        ended = opcode in (Opcode.DATA_END, Opcode.FOOTER)
        offset += block.length
    if not ended:
        words = f"truncated after {index.message_count} messages (record at byte {offset} of {size} is not whole)"
        index.problems.append(("truncated", words))
    index.blocks.sort(key=_place)
    return index


def _index_block(stream: IO[bytes], index: BagIndex, block: Block) -> None:
    try:
        records = _read_block(stream, block, None)
    except BagError as error:
        index.problems.append(("corrupt", str(error)))
        return
    messages = []
    for record in records:
        if isinstance(record, Message):
            messages.append(record)
        else:
            index.add(record)
    if messages:
        times = [message.log_time for message in messages]
        channels = Counter(message.channel for message in messages)
        index.blocks.append(block._replace(start_ns=min(times), channels=frozenset(channels)))
        index.message_count += len(times)
        index.counts.update(channels)
        index.end_ns = max(index.end_ns, *times)


def _read_block(stream: IO[bytes], block: Block, channels: Collection[int] | None) -> list[Message | Schema | Channel]:
    """Return schemas, channels and messages in a block, those of some channels (None for all).

    Raises:
        BagError: it cannot be read; tells its place and what is wrong with it.
    """
    where = f"record at byte {block.offset}"
    if block.length > MAX_CHUNK_BYTES:
        raise BagError(f"{where}: {block.length >> 20} MB: expected {MAX_CHUNK_BYTES >> 20} MB at most")
    stream.seek(block.offset)
    data = stream.read(block.length)
    try:
        opcode, length = _HEAD.unpack_from(data)
        if opcode == Opcode.CHUNK:
            chunk = Chunk.read(ReadDataStream(BytesIO(data[_HEAD.size :])))
            return _records(_unpacked(chunk, where), channels, where)
        if opcode not in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            raise BagError(f"{where}: opcode {opcode}, expected a chunk")
        return _records(data[: _HEAD.size + length], channels, where)
    except BagError:
        raise
    except Exception as error:  # broken bytes lead the parsers into errors of every kind
        raise BagError(f"{where} is damaged: {type(error).__name__}: {error}") from error


def _unpacked(chunk: Chunk, where: str) -> bytes:
    if chunk.compression not in _COMPRESSIONS:
        raise BagError(f"{where}: chunk compression {chunk.compression!r} is unknown: expected zstd, lz4 or none")
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        claim = f"a chunk of {len(chunk.data)} bytes that claims to be {chunk.uncompressed_size >> 20} MB"
        raise BagError(f"{where}: {claim}: expected {MAX_CHUNK_BYTES >> 20} MB at most: record in smaller chunks")
    # A chunk is unpacked as far as it says itself.
    data = unpack(chunk.compression, chunk.data, chunk.uncompressed_size) if chunk.compression else chunk.data
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise BagError(f"{where} is damaged: its checksum is another")
    return data


def _records(data: bytes, channels: Collection[int] | None, where: str) -> list[Message | Schema | Channel]:
    """Return what stands in the bytes of a chunk; records of other kinds are passed over."""
    found: list[Message | Schema | Channel] = []
    at = count = 0
    while at < len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        begin = at + _HEAD.size
        at, count = begin + length, count + 1
        if at > len(data) or count > MAX_CHUNK_RECORDS:
            raise BagError(f"{where} is damaged: record {count} of {length} bytes in a chunk of {len(data)}")
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = _MESSAGE.unpack_from(data, begin)
            if channels is None:
                found.append(Message(channel, log_time, b""))
            elif channel in channels:
                found.append(Message(channel, log_time, data[begin + _MESSAGE.size : at]))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            content = ReadDataStream(BytesIO(data[begin:at]))
            found.append(Schema.read(content) if opcode == Opcode.SCHEMA else Channel.read(content))
    return found
