"""Messages of an indexed MCAP file in the order of their log times.

mcap's own reader does the same with a heap of Python objects that compare themselves and a method call for every
number; a third of a replay's time went there. Here chunks are taken apart in one go and lists of tuples are sorted,
which is next to nothing as most are in order already. A chunk is read when the next message is not older than it, so
a few chunks are in memory at once.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Iterator
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import get_chunk_data_stream

#: Before a record's content: opcode and length.
_RECORD = struct.Struct("<BQ")
RECORD_HEADER = _RECORD.size
#: What a message begins with: channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<HIQQ")


def ordered_messages(file: IO[bytes], topics: set[str] | None) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """All messages, or those of some topics (named without leading slash); equal log times in the file's order.

    Args:
        file: opened for reading bytes; must have a summary.
        topics: None for all.

    Raises:
        McapError and others of `mcap_salvage.DAMAGE`: the file is damaged.
    """
    reader = SeekingReader(file, validate_crcs=True)
    summary = reader.get_summary()
    if summary is None or not summary.chunk_indexes:
        names = None if topics is None else {t for topic in topics for t in (topic, f"/{topic}")}
        yield from reader.iter_messages(topics=names, log_time_order=True)
        return
    wanted = {k for k, c in summary.channels.items() if topics is None or c.topic.strip("/") in topics}
    chunks = [c for c in summary.chunk_indexes if not c.message_index_offsets or wanted & set(c.message_index_offsets)]
    chunks.sort(key=lambda c: (c.message_start_time, c.chunk_start_offset))
    waiting: list[tuple[int, int, int, Message]] = []
    for chunk_index in chunks:
        older = bisect_left(waiting, (chunk_index.message_start_time,))
        for entry in waiting[:older]:
            yield _named(entry[3], summary.channels, summary.schemas)
        file.seek(chunk_index.chunk_start_offset + RECORD_HEADER)
        chunk = Chunk.read(ReadDataStream(file))
        at = chunk_index.chunk_start_offset
        added = [(m.log_time, at, k, m) for k, m in enumerate(_messages(chunk)) if m.channel_id in wanted]
        waiting = sorted(waiting[older:] + added)
    for entry in waiting:
        yield _named(entry[3], summary.channels, summary.schemas)


def _messages(chunk: Chunk) -> list[Message]:
    """The messages of a chunk in the file's order.

    Raises:
        McapError and others of `mcap_salvage.DAMAGE`: the chunk is damaged.
    """
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    data: bytes = stream.read(length)
    messages = []
    at = 0
    while at < length:
        opcode, size = _RECORD.unpack_from(data, at)
        begin = at + RECORD_HEADER
        at = begin + size
        if opcode == Opcode.MESSAGE:
            if at > length or size < _MESSAGE.size:
                raise McapError(f"a message of {size} bytes in a chunk of {length}")
            channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, begin)
            content = data[begin + _MESSAGE.size : at]
            messages.append(
                Message(
                    channel_id=channel_id,
                    log_time=log_time,
                    data=content,
                    publish_time=publish_time,
                    sequence=sequence,
                )
            )
    return messages


def _named(
    message: Message, channels: dict[int, Channel], schemas: dict[int, Schema]
) -> tuple[Schema | None, Channel, Message]:
    channel = channels[message.channel_id]
    return schemas.get(channel.schema_id), channel, message
