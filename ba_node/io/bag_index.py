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
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, TYPE_CHECKING, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from ba_node.io.bag_errors import BagError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

MAGIC = b"\x89MCAP0\r\n"

# opcode (1 byte) and length (8 bytes) in front of every record
_HEAD = struct.Struct("<BQ")
_COMPRESSIONS = ("", "lz4", "zstd")


class Block(NamedTuple):
    """A record that holds messages: a chunk, or a message that stands alone. Sorts by time, then place in the file.

    Attributes:
        start_ns: smallest log time in it, ns.
        offset: where it begins, bytes.
        length: with its head, bytes.
    """

    start_ns: int
    offset: int
    length: int


@dataclass
class BagIndex:
    """Where the messages of a file are.

    Attributes:
        schemas: by id.
        channels: by id.
        blocks: what holds messages, sorted.
        message_count: number of messages that can be read.
        problems: what is wrong with the file, as (reason, words).
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    message_count: int = 0
    problems: list[tuple[str, str]] = field(default_factory=list)

    def add(self, record: McapRecord) -> None:
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
    if stream.read(len(MAGIC)) != MAGIC:
        raise BagError("not an MCAP file: it does not begin with the MCAP magic bytes")
    index = _from_summary(stream, size) or _from_records(stream, size)
    if index.message_count == 0:
        why = "; ".join(words for _, words in index.problems) or "it was closed before anything was recorded"
        raise BagError(f"no message can be read: {why}")
    return index


def read_messages(
    stream: IO[bytes], index: BagIndex, channels: Collection[int], report: Callable[[str, str], None]
) -> Iterator[Message]:
    """Yield the messages of some channels by log time; those of the same time in the order of the file.

    A block that cannot be read is passed over, and ``report`` gets the reason and the words.
    """
    waiting: list[tuple[tuple[int, int, int], Message, Iterator[tuple[tuple[int, int, int], Message]]]] = []
    blocks = iter(index.blocks)
    following = next(blocks, None)
    while waiting or following:
        # A block is opened only when its first message may come before all that wait.
        if following and (not waiting or following[:2] < waiting[0][0][:2]):
            messages = _sorted_messages(stream, index, following, channels, report)
            following = next(blocks, None)
        else:
            _, message, messages = heapq.heappop(waiting)
            yield message
        entry = next(messages, None)
        if entry:
            heapq.heappush(waiting, (*entry, messages))


def _sorted_messages(
    stream: IO[bytes], index: BagIndex, block: Block, channels: Collection[int], report: Callable[[str, str], None]
) -> Iterator[tuple[tuple[int, int, int], Message]]:
    try:
        records = _read_block(stream, block)
    except BagError as error:
        report("corrupt", str(error))
        return
    for record in records:
        index.add(record)
    messages = [r for r in records if isinstance(r, Message) and r.channel_id in channels]
    messages.sort(key=lambda message: message.log_time)
    for place, message in enumerate(messages):
        yield (message.log_time, block.offset, place), message


def _from_summary(stream: IO[bytes], size: int) -> BagIndex | None:
    """Return the index that the file brings, or None if there is none that can be trusted."""
    try:
        stream.seek(0)
        summary = SeekingReader(stream, record_size_limit=size).get_summary()
    except Exception:  # broken bytes lead the parser into errors of every kind
        return None
    if summary is None or summary.statistics is None or not summary.chunk_indexes:
        return None
    blocks = [Block(c.message_start_time, c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]
    used = {channel for chunk in summary.chunk_indexes for channel in chunk.message_index_offsets}
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    whole = all(block.offset + block.length <= size for block in blocks)
    if not whole or not used <= summary.channels.keys() or not schemas <= summary.schemas.keys():
        return None
    if not summary.channels:
        return None
    return BagIndex(summary.schemas, summary.channels, sorted(blocks), summary.statistics.message_count)


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
    index.blocks.sort()
    return index


def _index_block(stream: IO[bytes], index: BagIndex, block: Block) -> None:
    try:
        records = _read_block(stream, block)
    except BagError as error:
        index.problems.append(("corrupt", str(error)))
        return
    for record in records:
        index.add(record)
    times = [record.log_time for record in records if isinstance(record, Message)]
    if times:
        index.blocks.append(block._replace(start_ns=min(times)))
        index.message_count += len(times)


def _read_block(stream: IO[bytes], block: Block) -> list[McapRecord]:
    """Return the records in a block, or raise BagError with its place and what is wrong with it."""
    stream.seek(block.offset)
    data = stream.read(block.length)
    where = f"record at byte {block.offset}"
    try:
        opcode, length = _HEAD.unpack_from(data)
        content = ReadDataStream(BytesIO(data[_HEAD.size :]))
        if opcode == Opcode.MESSAGE:
            return [Message.read(content, length)]
        if opcode == Opcode.SCHEMA:
            return [Schema.read(content)]
        if opcode == Opcode.CHANNEL:
            return [Channel.read(content)]
        if opcode != Opcode.CHUNK:
            raise BagError(f"{where}: opcode {opcode}, expected a chunk")
        chunk = Chunk.read(content)
        if chunk.compression not in _COMPRESSIONS:
            raise BagError(f"{where}: chunk compression {chunk.compression!r} is unknown: expected zstd, lz4 or none")
        return breakup_chunk(chunk, validate_crc=True)
    except BagError:
        raise
    except Exception as error:  # broken bytes lead the parsers into errors of every kind
        raise BagError(f"{where} is damaged: {type(error).__name__}: {error}") from error
