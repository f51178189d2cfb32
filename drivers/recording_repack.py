"""Packs a finished recording tighter, without a change to any message.

MCAP compresses chunk by chunk. Here chunks are large, hold one topic after the other, as messages of a topic look
much like each other, and zstd takes all the time it wants, which a robot that records has not got: a quarter of what
the sensors deliver is saved. Readers that go by index or log time notice nothing; a file that is cut loses more.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.summary import Summary

from drivers.mcap_salvage import DAMAGE
from drivers.recording_contents import MAGIC
from drivers.recording_format import RecordingError

#: zstd's level that is slowest on writing and no slower on reading.
LEVEL = 19
#: Size of a chunk before compression, forty seconds of the whole robot: beyond, compression gains next to nothing.
CHUNK_BYTES = 4 * 1024 * 1024
#: What a message takes beside its data.
MESSAGE_BYTES = 31
#: Opcode, length, start of the summary and of its offsets.
FOOTER_START = struct.Struct("<BQQQ")


def repack(source: Path, destination: Path, level: int = LEVEL) -> None:
    """Write all that is in `source` to `destination`, packed tighter.

    Args:
        source: a complete recording, with index.
        destination: file to create; one that exists is overwritten.
        level: of zstd, 1 to 22.

    Raises:
        RecordingError: `source` is damaged or has no index, or a file cannot be read or written.
    """
    try:
        with source.open("rb") as file, destination.open("wb") as out:
            reader = SeekingReader(file, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise RecordingError(f"{source}: has no index; recover it with `mcap recover`")
            _Packer(out, reader, summary, summary.statistics, level).pack()
    except DAMAGE as error:
        raise RecordingError(f"{source}: damaged inside ({error}); recover it with `mcap recover`") from error
    except OSError as error:
        raise RecordingError(f"{error.filename or destination}: cannot repack: {error.strerror}") from error


def _content(builder: RecordBuilder) -> bytes:
    # mcap leaves this method without annotations.
    end: Callable[[], bytes] = builder.end
    return end()


class _Packer:
    def __init__(
        self, out: IO[bytes], reader: SeekingReader, summary: Summary, statistics: Statistics, level: int
    ) -> None:
        self._out, self._reader, self._summary, self._statistics = out, reader, summary, statistics
        self._compressor = zstandard.ZstdCompressor(level=level)
        self._chunk_indexes: list[ChunkIndex] = []

    def pack(self) -> None:
        self._out.write(MAGIC)
        self._add(self._reader.get_header())
        attachments = []
        for item in self._reader.iter_attachments():
            offset, length = self._add(item)
            attachments.append(
                AttachmentIndex(
                    offset, length, item.log_time, item.create_time, len(item.data), item.name, item.media_type
                )
            )
        metadata = [MetadataIndex(*self._add(item), item.name) for item in self._reader.iter_metadata()]
        messages: list[Message] = []
        size = 0
        for _, _, message in self._reader.iter_messages():
            messages.append(message)
            size += MESSAGE_BYTES + len(message.data)
            if size > CHUNK_BYTES:
                self._chunk(messages)
                messages, size = [], 0
        if messages:
            self._chunk(messages)
        self._add(DataEnd(0))
        self._finish(attachments, metadata)

    def _add(self, record: McapRecord) -> tuple[int, int]:
        """Write a record; returns where it begins and its length."""
        builder = RecordBuilder()
        record.write(builder)
        offset, data = self._out.tell(), _content(builder)
        self._out.write(data)
        return offset, len(data)

    def _chunk(self, messages: list[Message]) -> None:
        """Compress and write messages, given by log time, and their index."""
        builder = RecordBuilder()
        indexes: dict[int, list[tuple[int, int]]] = {}
        # A stable sort: within a channel, the order stays.
        for message in sorted(messages, key=lambda message: message.channel_id):
            if message.channel_id not in indexes:
                indexes[message.channel_id] = []
                self._tell(builder, self._summary.channels[message.channel_id])
            indexes[message.channel_id].append((message.log_time, builder.count))
            message.write(builder)
        data = _content(builder)
        packed = self._compressor.compress(data)
        first, last = messages[0].log_time, messages[-1].log_time
        offset, length = self._add(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
        written = [(channel, *self._add(MessageIndex(channel, index))) for channel, index in indexes.items()]
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_start_offset=offset,
                chunk_length=length,
                compression="zstd",
                compressed_size=len(packed),
                uncompressed_size=len(data),
                message_start_time=first,
                message_end_time=last,
                message_index_offsets={channel: start for channel, start, _ in written},
                message_index_length=sum(size for _, _, size in written),
            )
        )

    def _tell(self, builder: RecordBuilder, channel: Channel) -> None:
        """Say what the messages are, in every chunk, so that those of a damaged file can be read."""
        schema: Schema | None = self._summary.schemas.get(channel.schema_id)
        if schema is not None:
            schema.write(builder)
        channel.write(builder)

    def _finish(self, attachments: list[AttachmentIndex], metadata: list[MetadataIndex]) -> None:
        """Write the summary and the end."""
        self._statistics.chunk_count = len(self._chunk_indexes)
        groups: list[tuple[Opcode, Iterable[McapRecord]]] = [
            (Opcode.SCHEMA, self._summary.schemas.values()),
            (Opcode.CHANNEL, self._summary.channels.values()),
            (Opcode.STATISTICS, [self._statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, attachments),
            (Opcode.METADATA_INDEX, metadata),
        ]
        builder, start = RecordBuilder(), self._out.tell()
        offsets = []
        for opcode, records in groups:
            begin = builder.count
            for record in records:
                record.write(builder)
            if builder.count > begin:
                offsets.append(SummaryOffset(int(opcode), start + begin, builder.count - begin))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        data = _content(builder)
        self._out.write(data)
        # The checksum runs over the summary and over the footer up to the checksum itself.
        footer = FOOTER_START.pack(Opcode.FOOTER, 20, start, offset_start)
        self._add(Footer(start, offset_start, zlib.crc32(footer, zlib.crc32(data))))
        self._out.write(MAGIC)
