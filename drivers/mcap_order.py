"""Messages of an indexed MCAP file in the order of their log times.

mcap's own reader does the same with a heap of Python objects that compare themselves; a third of a replay's time went
there. Here the heap holds tuples, which compare in C. A chunk is read when the heap's next message is not older
than it, so a few chunks are in memory at once.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk

#: Bytes before a record's content: opcode and length.
RECORD_HEADER = 9


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
    heap: list[tuple[int, int, int, Message]] = []
    for chunk_index in chunks:
        while heap and heap[0][0] < chunk_index.message_start_time:
            yield _named(heapq.heappop(heap)[3], summary.channels, summary.schemas)
        file.seek(chunk_index.chunk_start_offset + RECORD_HEADER)
        chunk = Chunk.read(ReadDataStream(file))
        for k, record in enumerate(breakup_chunk(chunk, validate_crc=True)):
            if isinstance(record, Message) and record.channel_id in wanted:
                heapq.heappush(heap, (record.log_time, chunk_index.chunk_start_offset, k, record))
    while heap:
        yield _named(heapq.heappop(heap)[3], summary.channels, summary.schemas)


def _named(
    message: Message, channels: dict[int, Channel], schemas: dict[int, Schema]
) -> tuple[Schema | None, Channel, Message]:
    channel = channels[message.channel_id]
    return schemas.get(channel.schema_id), channel, message
